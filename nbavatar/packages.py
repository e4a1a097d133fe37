"""What to do about a package that cannot be imported: the pip line that brings it, or the system's libraries it wants.

The extras are read from this package's own metadata, so that no second list can differ. Standard library only.
"""
# provenance: neutral, because it words what is not installed.

import re
from functools import cache
from importlib import metadata

__all__ = ["distribution_of", "extra_of", "install_line", "installed", "remedy"]

# Import names that are not the distribution's own name.
_DISTRIBUTIONS = {
    "cv2": "opencv-contrib-python-headless",
    "igl": "libigl",
    "PIL": "pillow",
    "yaml": "pyyaml",
    "robust_laplacian": "robust-laplacian",
    "skimage": "scikit-image",
}
# Packages that are no use without libraries which pip cannot bring.
_SYSTEM = {"pymeshlab": "libgl1 libopengl0 libx11-6 libxcb1 libfontconfig1 libfreetype6"}


def distribution_of(module: str) -> str:
    """Name to give to pip for an import name, such as `pillow` for `PIL`."""
    return _DISTRIBUTIONS.get(module, module)


def installed(module: str) -> bool:
    """Whether pip has installed the package of an import name; it may still lack a library of the system."""
    try:
        return bool(metadata.version(distribution_of(module)))
    except metadata.PackageNotFoundError:
        return False


def remedy(module: str) -> str:
    """What to do if a module cannot be imported, as the end of an error line."""
    name = module.partition(".")[0]
    if name in _SYSTEM and installed(name):
        return f"on Debian and Ubuntu: apt-get install {_SYSTEM[name]}"
    if installed(name):  # it is there and does not load: what it was built against is not
        return f"run: python -m pip install --force-reinstall {distribution_of(name)}"
    return f"run: {install_line(name)}"


def install_line(module: str) -> str:
    """The pip command that installs a module: through an extra of this package where one declares it.

    Args:
        module: top-level import name, such as `cv2`.
    """
    package, extra = distribution_of(module), extra_of(module)
    return "python -m pip install " + (package if extra is None else f'"nbavatar[{extra}]"')


def extra_of(module: str) -> str | None:
    """The extra of this package that brings a module; None for what is always installed and for what none brings."""
    return _extras().get(_normal(distribution_of(module)))


@cache
def _extras() -> dict[str, str]:
    """Distribution -> the extra that declares it; those that are always installed are not in it."""
    found: dict[str, str] = {}
    try:
        declared = metadata.requires("nbavatar") or []
    except metadata.PackageNotFoundError:
        declared = []
    for requirement in declared:
        name = re.match(r"[\w.-]+", requirement)
        extra = re.search(r"extra == ['\"]([\w-]+)['\"]", requirement)
        if name and extra:
            found.setdefault(_normal(name.group()), extra.group(1))
    return found


def _normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()
