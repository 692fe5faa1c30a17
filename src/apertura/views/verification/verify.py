"""`apertura verify`: for each link of a product's chain, whether it is the same, changed or missing."""

from pathlib import Path

from apertura.common.errors import CampaignError, shown
from apertura.views.verification.chain import Chain
from apertura.views.verification.links import Link
from apertura.views.verification.products import Product, find_product, manifests
from apertura.views.verification.tags import document, read_tags

_ORDER = ("changed", "missing", "same")
_LONGEST = 300


def verify(path: Path, campaign: Path | None = None) -> Chain:
    """Compare a product, or all of a campaign, with what it says it was made from, down to the raw samples.

    Parameters
    ----------
    path
        Absolute: a file, a stage or a manifest below results/, or a campaign folder.
    campaign
        Where a file that lies elsewhere was made.

    Returns
    -------
    Chain
        Its links; every byte was read, and nothing written.

    Raises
    ------
    CampaignError
        If it is no product, or its campaign is not known.
    """
    product = find_product(path, campaign)
    chain = Chain(product.root)
    if product.file is None:
        there = [found.relative_to(product.root).as_posix() for found in manifests(product.root / "results")]
        chain.walk(dict.fromkeys([*chain.promised(), *there]))
        return chain
    _begin(chain, product, product.file)
    chain.walk([product.manifest] if product.manifest else [])
    return chain


def _begin(chain: Chain, product: Product, file: Path) -> None:
    """Begin a chain at a file: with its manifest where that lists it, else with its tags."""
    inside = file.is_relative_to(product.root)
    name = file.relative_to(product.root).as_posix() if inside else file.name
    if product.manifest:
        if not inside:
            chain.links.of(f"{name}, a copy of a file of {product.manifest}")
        return
    if not chain.tagged(file, name):
        expected = "a file of a result, or one that carries tags"
        raise CampaignError("no manifest lists it", file, expected, "Name a file that the workflow wrote.")
    found = "no manifest lists it" if inside else "no file of that campaign has its bytes"
    chain.links.of(name).add("changed", f"{found}; its tags say what it was made from")


def print_verified(path: Path, campaign: Path | None = None, *, quiet: bool = False) -> int:
    """Print a line for each link, what is wrong first; return 0, or 1 where a link is not the same.

    Parameters
    ----------
    path, campaign
        As `verify`.
    quiet
        Only what is not the same.

    Raises
    ------
    CampaignError
        As `verify`; what the tags of a file say is printed before.
    """
    try:
        chain = verify(path, campaign)
    except CampaignError:
        _print_tags(path)
        raise
    links = sorted(chain.links, key=lambda link: _ORDER.index(link.state))
    for link in links:
        if link.state != "same" or not quiet:
            print(_line(link))
    for note in chain.notes:
        print(shown(note, _LONGEST))
    counts = [(state, sum(link.state == state for link in links)) for state in reversed(_ORDER)]
    if not quiet:
        print(f"{len(links)} links: {', '.join(f'{count} {state}' for state, count in counts if count)}")
    return 0 if all(link.state == "same" for link in links) else 1


def _line(link: Link) -> str:
    why = f": {'; '.join(link.why)}" if link.why else ""
    return f"{link.state:<8} {shown(link.name + why, _LONGEST)}"


def _print_tags(path: Path) -> None:
    """Print what a file says of itself where nothing else can."""
    if not path.is_file():
        return
    tags = read_tags(path)
    for name, text in sorted(tags.items()):
        if name in {"APERTURA_INPUTS", "APERTURA_SOURCES"}:
            for role, digest in document(tags, name.removeprefix("APERTURA_"), path).items():
                print(shown(f"{name} {role} {digest}", _LONGEST))
        else:
            print(shown(f"{name} {text}", _LONGEST))
