"""Run by a Python that has QGIS, never imported: say what QGIS makes of rasters, sample and draw them.

What is asked comes as JSON on stdin: {"tell": [raster], "sample": {raster: [[x, y]]}, "draw": {raster: [png, width]}}.
"""

import json
import os
import sys

os.environ["QT_QPA_PLATFORM"] = "offscreen"
from qgis.core import (
    QgsApplication,
    QgsColorRampLegendNode,
    QgsContrastEnhancement,
    QgsLayerTreeModel,
    QgsMapRendererParallelJob,
    QgsMapSettings,
    QgsPointXY,
    QgsProject,
    QgsRasterLayer,
    QgsRasterSymbolLegendNode,
)
from qgis.PyQt.QtCore import QSize, Qt
from qgis.PyQt.QtGui import QColor


def told(path: str) -> dict[str, object]:
    """Return what the layer says; its style is the one that QGIS found by itself."""
    layer = QgsRasterLayer(path, "raster")
    provider, renderer, extent = layer.dataProvider(), layer.renderer(), layer.extent()
    width, height = (
        size / pixels for size, pixels in ((extent.width(), layer.width()), (extent.height(), layer.height()))
    )
    found: dict[str, object] = {
        "valid": layer.isValid(),
        "crs": layer.crs().authid(),
        "wkt": layer.crs().toWkt(),
        "transform": [width, 0.0, extent.xMinimum(), 0.0, -height, extent.yMaximum()],
        "shape": [layer.height(), layer.width()],
        "nodata": provider.sourceNoDataValue(1) if provider.sourceHasNoDataValue(1) else None,
        "renderer": renderer.type(),
    }
    root = QgsProject.instance().layerTreeRoot()
    QgsProject.instance().addMapLayer(layer)
    model = QgsLayerTreeModel(root)  # must outlive its nodes
    nodes = model.layerLegendNodes(root.findLayer(layer.id()))
    found["legend"] = [node.data(Qt.DisplayRole) for node in nodes if isinstance(node, QgsRasterSymbolLegendNode)]
    ramps = [node.settings() for node in nodes if isinstance(node, QgsColorRampLegendNode)]
    found["legend"] += [settings.suffix() for settings in ramps]
    if renderer.type() == "singlebandgray" and renderer.contrastEnhancement():
        stretch: QgsContrastEnhancement = renderer.contrastEnhancement()
        found["stretch"] = [stretch.minimumValue(), stretch.maximumValue()]
    if renderer.type() == "paletted":
        found["classes"] = {str(int(one.value)): [one.label, one.color.alpha()] for one in renderer.classes()}
    if renderer.type() == "singlebandpseudocolor":
        found["stretch"] = [renderer.classificationMin(), renderer.classificationMax()]
    return found


def sampled(path: str, places: list[tuple[float, float]]) -> list[float | None]:
    """Return the values of the pixels at places (x, y) of the raster's own CRS; None without one."""
    layer = QgsRasterLayer(path, "raster")  # must outlive its provider
    provider = layer.dataProvider()
    found = [provider.sample(QgsPointXY(x, y), 1) for x, y in places]
    return [value if known else None for value, known in found]


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
sys.stdout.write(
    json.dumps(
        {
            "told": {path: told(path) for path in asked.get("tell", [])},
            "sampled": {path: sampled(path, places) for path, places in asked.get("sample", {}).items()},
            "errors": {path: draw(path, *into) for path, into in asked.get("draw", {}).items()},
        }
    )
)
sys.stdout.flush()
os._exit(0)  # QGIS without a screen may crash when it is taken down
