"""Importers of the formats that users already have their data in: VHAP, nerfstudio, COLMAP, sequences of mesh files.

Written from descriptions of the formats and from files, not from other projects' code.
"""
