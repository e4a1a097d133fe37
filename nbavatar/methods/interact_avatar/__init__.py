"""After InteractAvatar (Chen et al. 2025): bound Gaussians that networks change with the hand's pose and its touch."""
