"""Ways to make an avatar, a package each, beside their contract (`base`), their list (`registry`) and their files
(`storage`).
"""
