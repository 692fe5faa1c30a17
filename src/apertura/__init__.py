"""apertura: campaign folders of UAV-borne digital radar recordings in, georeferenced SAR images out.

The public names are imported from their modules when they are first used: importing apertura loads no library.

Examples
--------
>>> import apertura as ap
>>> ap.SceneGrid.__module__
'apertura.scene.grid'
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from apertura.focus.inputs import Profiles as Profiles
    from apertura.scene.grid import SceneGrid as SceneGrid

__version__ = "0.1.0"

_PUBLIC = {
    "Aperture": "apertura.geometry.aperture",
    "Dem": "apertura.scene.dem",
    "FlatGround": "apertura.scene.terrain",
    "PhaseHistory": "apertura.focus.inputs",
    "Plane": "apertura.scene.terrain",
    "Profiles": "apertura.focus.inputs",
    "RecordedFlight": "apertura.load.writing",
    "RecordedNode": "apertura.load.writing",
    "SceneGrid": "apertura.scene.grid",
    "backproject": "apertura.imaging.backproject",
    "gradient": "apertura.imaging.gradient",
    "open_campaign": "apertura.load.results",
    "open_dem": "apertura.scene.dem_file",
    "range_compress": "apertura.imaging.range_profiles",
    "simulate": "apertura.simulation",
    "write_campaign": "apertura.load.writing",
}
"""Public name → module that defines it."""

__all__ = list(_PUBLIC)


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return globals().setdefault(name, getattr(import_module(_PUBLIC[name]), name))


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
