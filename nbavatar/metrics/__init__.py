"""Image metrics: PSNR, SSIM, LPIPS. Pure functions of arrays; import the module that you need."""

__all__: list[str] = []
