"""The avatar: neural billboards on a mesh, the U-Net renderer, and the losses that train them (paper, sections 3.2 to
3.4).
"""
