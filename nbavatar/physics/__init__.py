"""Contact deformation of a soft head by rigid hands."""
