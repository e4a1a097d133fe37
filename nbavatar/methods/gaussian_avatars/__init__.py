"""GaussianAvatars (Qian et al. 2024): Gaussians bound to triangles."""
