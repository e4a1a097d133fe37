"""Multi-view refit of head and hand models to keypoints and silhouettes."""
