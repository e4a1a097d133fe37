"""Published Gaussian avatars, trained by the same trainer on the same data: GaussianAvatars and SplattingAvatar."""
