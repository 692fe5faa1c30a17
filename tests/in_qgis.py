"""Run by a Python that has QGIS, never imported: say as JSON what QGIS makes of some rasters, and draw one of them.

python in_qgis.py RASTER…  --draw RASTER PNG WIDTH
"""

import json
import os
import sys

os.environ["QT_QPA_PLATFORM"] = "offscreen"
from qgis.core import (
    QgsApplication,
    QgsContrastEnhancement,
    QgsMapRendererParallelJob,
    QgsMapSettings,
    QgsPointXY,
    QgsProject,
    QgsRasterLayer,
)
from qgis.PyQt.QtCore import QSize
from qgis.PyQt.QtGui import QColor


def told(path: str) -> dict[str, object]:
    """Return what the layer says; its style is the one that QGIS found by itself."""
    layer = QgsRasterLayer(path, "raster")
    provider, renderer, extent = layer.dataProvider(), layer.renderer(), layer.extent()
    found: dict[str, object] = {
        "valid": layer.isValid(),
        "crs": layer.crs().authid(),
        "wkt": layer.crs().toWkt(),
        "extent": [extent.xMinimum(), extent.yMinimum(), extent.xMaximum(), extent.yMaximum()],
        "size": [layer.width(), layer.height()],
        "nodata": str(provider.sourceNoDataValue(1)) if provider.sourceHasNoDataValue(1) else None,
        "renderer": renderer.type(),
    }
    if renderer.type() == "singlebandgray" and renderer.contrastEnhancement():
        stretch: QgsContrastEnhancement = renderer.contrastEnhancement()
        found["stretch"] = [stretch.minimumValue(), stretch.maximumValue()]
    if renderer.type() == "paletted":
        found["classes"] = {str(int(one.value)): [one.label, one.color.alpha()] for one in renderer.classes()}
    if renderer.type() == "singlebandpseudocolor":
        found["stretch"] = [renderer.classificationMin(), renderer.classificationMax()]
    return found


def sampled(path: str, x: float, y: float) -> float | None:
    """Return the value of the pixel at a place of the raster's own CRS; None without one."""
    value, known = QgsRasterLayer(path, "raster").dataProvider().sample(QgsPointXY(x, y), 1)
    return value if known else None


def draw(path: str, picture: str, width: int) -> list[str]:
    """Draw a raster as QGIS shows it, on ground of a colour that no style has; return what went wrong."""
    layer = QgsRasterLayer(path, "raster")
    QgsProject.instance().addMapLayer(layer)
    settings = QgsMapSettings()
    settings.setLayers([layer])
    settings.setBackgroundColor(QColor(255, 240, 200))
    settings.setOutputSize(QSize(width, round(width * layer.height() / layer.width())))
    settings.setDestinationCrs(layer.crs())
    settings.setExtent(layer.extent())
    job = QgsMapRendererParallelJob(settings)
    job.start()
    job.waitForFinished()
    job.renderedImage().save(picture)
    return [error.message for error in job.errors()]


asked = json.load(sys.stdin)
QgsApplication.setPrefixPath("/usr", True)
application = QgsApplication([], False)
application.initQgis()
print(
    json.dumps(
        {
            "told": {path: told(path) for path in asked.get("tell", [])},
            "sampled": {path: sampled(path, *at) for path, at in asked.get("sample", {}).items()},
            "errors": {path: draw(path, *into) for path, into in asked.get("draw", {}).items()},
        }
    )
)
sys.stdout.flush()
os._exit(0)  # QGIS without a screen may crash when it is taken down
