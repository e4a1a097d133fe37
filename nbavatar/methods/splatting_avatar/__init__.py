"""SplattingAvatar (Shao et al. 2024): Gaussians embedded in the surface."""
