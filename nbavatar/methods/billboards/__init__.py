"""The paper's method: neural billboards and their U-Net."""
