"""Rule `mosaic`: each product of all flights as one raster for a GIS, on the campaign's grid."""

from collections.abc import Sequence
from pathlib import Path

from apertura.campaign.folder import Campaign
from apertura.campaign.store import read_manifest, record_files, remake_from
from apertura.common.errors import CampaignError
from apertura.common.provenance import sha256_file
from apertura.formats.export import EXPORTS, MOSAICS, mosaics, remove_outdated
from apertura.formats.export.mosaic import write_mosaic
from apertura.workflow.lineage import result_of


def mosaic(campaign: Campaign) -> Sequence[Path]:
    """Write results/mosaic/<pair>/<product>.vrt and their styles; return their paths.

    Flights lie upon one another in the order of config/flights.tsv, the last uppermost.
    """
    lineage = result_of(campaign, "mosaic").begin(campaign.root)
    # product → the manifest that describes it, and its hash there
    paths = [campaign.root / manifest for manifest in lineage.result.sources]
    described = {
        path.parent / name: (path, digest) for path in paths for name, digest in read_manifest(path)["files"].items()
    }
    styles = {row.file: row for row in EXPORTS if row.style}
    written = []
    for name, files in mosaics(campaign.images, campaign.coefficients).items():
        path, sources = campaign.result(MOSAICS, name), [campaign.result(file) for file in files]
        for source in sources:
            manifest, digest = described.get(source, (source, ""))
            if not source.is_file() or sha256_file(source) != digest:
                raise CampaignError(
                    "not as it was written" if source.is_file() else "no such file",
                    where=source,
                    expected=f"what {manifest.name} describes",
                    remedy=remake_from(manifest),
                )
        flown = f"{len(sources)} flight{'s' * (len(sources) > 1)}"
        title = f"{campaign.settings.campaign} · {name.removesuffix('.vrt')} of {flown}"
        write_mosaic(path, sources, title=title)
        written.append(path)
        if style := styles.get(path.with_suffix(".qml").name):
            written.append(path.with_suffix(".qml"))
            style.write(written[-1])
    for folder in {path.parent for path in written}:
        remove_outdated(folder, written)
    record_files(campaign.root / lineage.result.manifest, written, lineage)
    return written
