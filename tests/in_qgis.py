"""Script for a Python with QGIS, never imported: report how QGIS reads rasters; sample and draw the rasters.

Requests come as JSON on stdin: {"tell": [raster], "sample": {raster: [[x, y]]}, "draw": {raster: [png, width]}}.
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


def described(path: str) -> dict[str, object]:
    """Return the properties of a layer, with the style that QGIS selects automatically."""
    layer = QgsRasterLayer(path, "raster")
    provider, renderer, extent = layer.dataProvider(), layer.renderer(), layer.extent()
    width, height = (
        size / pixels for size, pixels in ((extent.width(), layer.width()), (extent.height(), layer.height()))
    )
    properties: dict[str, object] = {
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
    model = QgsLayerTreeModel(root)  # must exist longer than its nodes
    nodes = model.layerLegendNodes(root.findLayer(layer.id()))
    properties["legend"] = [node.data(Qt.DisplayRole) for node in nodes if isinstance(node, QgsRasterSymbolLegendNode)]
    ramps = [node.settings() for node in nodes if isinstance(node, QgsColorRampLegendNode)]
    properties["legend"] += [settings.suffix() for settings in ramps]
    if renderer.type() == "singlebandgray" and renderer.contrastEnhancement():
        stretch: QgsContrastEnhancement = renderer.contrastEnhancement()
        properties["stretch"] = [stretch.minimumValue(), stretch.maximumValue()]
    if renderer.type() == "paletted":
        properties["classes"] = {
            str(int(entry.value)): [entry.label, entry.color.alpha()] for entry in renderer.classes()
        }
    if renderer.type() == "singlebandpseudocolor":
        properties["stretch"] = [renderer.classificationMin(), renderer.classificationMax()]
    return properties


def sampled(path: str, places: list[tuple[float, float]]) -> list[float | None]:
    """Return the values of the pixels at points (x, y) in the raster's own CRS; None without a value."""
    layer = QgsRasterLayer(path, "raster")  # must exist longer than its provider
    provider = layer.dataProvider()
    samples = [provider.sample(QgsPointXY(x, y), 1) for x, y in places]
    return [value if valid else None for value, valid in samples]


def draw(path: str, picture: str, width: int) -> list[str]:
    """Draw a raster in QGIS, on a background of a colour that no style uses; return the errors."""
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


requests = json.load(sys.stdin)
QgsApplication.setPrefixPath("/usr", True)
application = QgsApplication([], False)
application.initQgis()
sys.stdout.write(
    json.dumps(
        {
            "told": {path: described(path) for path in requests.get("tell", [])},
            "sampled": {path: sampled(path, places) for path, places in requests.get("sample", {}).items()},
            "errors": {path: draw(path, *into) for path, into in requests.get("draw", {}).items()},
        }
    )
)
sys.stdout.flush()
os._exit(0)  # QGIS without a display may crash during shutdown
