"""Which code makes each result: a change of it makes the result again."""

from apertura.export import export_modules
from apertura.focus.engines import ENGINES
from apertura.provenance import code_sha256

_MODULES = {
    "raw": "apertura.steps.ingest",
    "track": "apertura.steps.ingest",
    "refined_track": "apertura.steps.refine",
    "assessment": "apertura.steps.assess",
    "fused": "apertura.steps.export",
    "report": "apertura.steps.page",
    "map": "apertura.steps.webmap",
    "speed_accuracy": "apertura.study.chart.speed_accuracy",
    "whole": "apertura.study.chart.whole",
}
"""Results that are called otherwise than the module of `apertura.steps` that makes them."""


def code_of(result: str) -> str:
    """Return the hash of the code that makes a result, a key of `apertura.lineage.RESULTS`.

    Examples
    --------
    >>> code_of("raw") == code_of("track") != code_of("echo")
    True
    """
    tables = {"image": ENGINES.values(), "refined_track": ENGINES.values(), "export": export_modules("pair")}
    tables |= {kind: export_modules(kind) for kind in ("fused", "layers", "interferogram")}
    return code_sha256(_MODULES.get(result, f"apertura.steps.{result}"), *tables.get(result, ()))
