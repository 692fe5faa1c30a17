"""Create a QGIS project of all dB images of a campaign: python3 qgis_project.py CAMPAIGN, with the Python of QGIS.

Coherent sums are the topmost layers. QGIS applies the style file (.qml) next to each image. The project is written to
CAMPAIGN/campaign.qgz; an existing project is not overwritten.
"""

import os
import sys
from pathlib import Path

os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")
from qgis.core import QgsApplication, QgsProject, QgsRasterLayer

campaign = Path(sys.argv[1]).resolve()
if (campaign / "campaign.qgz").exists():
    sys.exit(f"{campaign / 'campaign.qgz'} exists already: move or rename it")
qgis = QgsApplication([], False)
qgis.initQgis()
project = QgsProject.instance()
images = sorted(campaign.glob("results/*/*/*db.tif"), key=lambda path: path.name != "coherent_db.tif")
for path in images:
    layer = QgsRasterLayer(str(path), " ".join(path.relative_to(campaign / "results").with_suffix("").parts))
    project.addMapLayer(layer, False)
    node = project.layerTreeRoot().addLayer(layer)
    node.setItemVisibilityChecked(path == images[0])
    project.setCrs(layer.crs())
project.write(str(campaign / "campaign.qgz"))
print(len(images), "images,", project.crs().authid())
