"""Rule `mosaic`: GDAL virtual mosaics of each product over all flights, on the campaign's grid."""

from collections.abc import Sequence
from pathlib import Path

from apertura.campaign.folder import Campaign
from apertura.campaign.store import read_manifest, record_files, remake_from
from apertura.common.errors import CampaignError, number_of
from apertura.common.provenance import sha256_file
from apertura.formats.export import EXPORTS, MOSAICS, mosaics, remove_outdated
from apertura.formats.export.mosaic import write_mosaic
from apertura.workflow.lineage import result_of


def mosaic(campaign: Campaign) -> Sequence[Path]:
    """Write results/mosaic/<pair>/<product>.vrt and their styles; return their paths.

    Where flights overlap, the flight that is last in config/flights.tsv is on top.
    """
    lineage = result_of(campaign, "mosaic").begin(campaign.root)
    # product → the manifest that lists the product, and the product's hash in that manifest
    paths = [campaign.root / manifest for manifest in lineage.result.sources]
    listed = {
        path.parent / name: (path, digest) for path in paths for name, digest in read_manifest(path)["files"].items()
    }
    styles = {row.file: row for row in EXPORTS if row.style}
    written = []
    for name, files in mosaics(campaign.images, campaign.coefficients).items():
        path, sources = campaign.result(MOSAICS, name), [campaign.result(file) for file in files]
        for source in sources:
            manifest, digest = listed.get(source, (source, ""))
            if not source.is_file() or sha256_file(source) != digest:
                raise CampaignError(
                    "the file has changed since it was written" if source.is_file() else "no such file",
                    where=source,
                    expected=f"the file listed in {manifest.name}",
                    remedy=remake_from(manifest),
                )
        title = f"{campaign.settings.campaign} · {name.removesuffix('.vrt')} of {number_of(len(sources), 'flight')}"
        write_mosaic(path, sources, title=title)
        written.append(path)
        if style := styles.get(path.with_suffix(".qml").name):
            written.append(path.with_suffix(".qml"))
            style.write(written[-1])
    for folder in {path.parent for path in written}:
        remove_outdated(folder, written)
    record_files(campaign.root / lineage.result.manifest, written, lineage)
    return written
