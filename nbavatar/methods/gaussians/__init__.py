"""What methods of 3D Gaussians on meshes share."""
