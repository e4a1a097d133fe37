"""Triangle meshes: topology, face frames, Laplacians, spectral coordinates, silhouettes."""
