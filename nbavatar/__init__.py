"""NBAvatar: head avatars with hand-face contact, made of neural billboards.

What `__all__` names is for programs and stays as it is between versions; docs/library.md shows its use. It is imported
when it is first asked for: `import nbavatar` alone loads neither torch nor NumPy.
"""
# provenance: neutral, because it holds the version and names.

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nbavatar.api import (
        Camera,
        NBAvatarError,
        Rendered,
        load_avatar,
        load_meshes,
        look_at,
        pose,
        render,
        train,
    )

__version__ = "0.2.0"

__all__ = [
    "Camera",
    "NBAvatarError",
    "Rendered",
    "__version__",
    "load_avatar",
    "load_meshes",
    "look_at",
    "pose",
    "render",
    "train",
]


def __getattr__(name: str) -> Any:
    """Imports a public name when it is first used."""
    if name not in __all__:
        raise AttributeError(f"module 'nbavatar' has no attribute '{name}'")
    from nbavatar import api

    return getattr(api, name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
