"""apertura: georeferenced SAR images from campaign folders of UAV-borne digital radar recordings.

Public names are imported from their modules on first use: `import apertura` alone loads no library.

Examples
--------
>>> import apertura as ap
>>> ap.SceneGrid.__module__
'apertura.core.scene.grid'
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from apertura.core.backprojection.inputs import Profiles as Profiles
    from apertura.core.scene.grid import SceneGrid as SceneGrid

__version__ = "0.1.0"

_PUBLIC = {
    "Aperture": "apertura.core.geometry.aperture",
    "Atmosphere": "apertura.core.geometry.atmosphere",
    "Dem": "apertura.core.scene.dem",
    "FlatGround": "apertura.core.scene.terrain",
    "Link": "apertura.core.imaging.radiometry",
    "PhaseHistory": "apertura.core.backprojection.inputs",
    "Plane": "apertura.core.scene.terrain",
    "Profiles": "apertura.core.backprojection.inputs",
    "RecordedFlight": "apertura.tools.write_campaign",
    "RecordedNode": "apertura.tools.write_campaign",
    "SceneGrid": "apertura.core.scene.grid",
    "backproject": "apertura.core.imaging.backproject",
    "campaign_from_files": "apertura.tools.init",
    "design": "apertura.tools.design",
    "gradient": "apertura.core.imaging.gradient",
    "judge": "apertura.core.imaging.judgement",
    "open_campaign": "apertura.tools.open_campaign",
    "open_dem": "apertura.core.scene.dem",
    "process": "apertura.run.process",
    "range_compress": "apertura.core.imaging.range_profiles",
    "read_geotiff": "apertura.formats.export.geotiff",
    "simulate": "apertura.simulation",
    "wave_speed": "apertura.core.geometry.atmosphere",
    "write_campaign": "apertura.tools.write_campaign",
    "write_geotiff": "apertura.formats.export.geotiff",
}
"""Public name → module that defines it."""

_ON_LINUX = frozenset(
    (
        *("Dem", "RecordedFlight", "RecordedNode", "campaign_from_files", "design", "open_campaign", "open_dem"),
        *("process", "read_geotiff", "simulate", "write_campaign", "write_geotiff"),
    )
)
"""Public names that access campaign folders or rasters; the others work on every operating system."""

__all__ = list(_PUBLIC)


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    if name in _ON_LINUX:
        from apertura.common.platforms import require_linux

        require_linux(f"apertura.{name}")
    return globals().setdefault(name, getattr(import_module(_PUBLIC[name]), name))


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
