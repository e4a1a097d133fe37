"""NBAvatar: head avatars with hand-face contact, made of neural billboards."""
# provenance: neutral, because it holds the version.

__version__ = "0.1.0"

__all__ = ["__version__"]
