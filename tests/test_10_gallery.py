"""The gallery shows a picture of every how-to and every example, each small, and made by one script."""

import re

import gallery
import pytest
from folders import ROOT
from PIL import Image

PAGE = (ROOT / "docs/gallery.md").read_text(encoding="utf-8")
SHOWN = re.findall(r"^!\[.+\]\(assets/gallery/(\w+)\.png\)\{ width=\"560\" \}$", PAGE, re.M)
EXAMPLES = {"ci": ".test", **{path.parent.name: path.parent.name for path in ROOT.glob("examples/*/README.md")}}


def test_the_page_shows_what_the_script_makes_and_nothing_else_lies_there():
    assert len(set(SHOWN)) == len(SHOWN)
    assert set(SHOWN) == set(gallery.MAKERS) == {path.stem for path in gallery.PICTURES.iterdir()}


@pytest.mark.parametrize("name", SHOWN)
def test_a_picture_is_small_and_not_empty(name):
    path = gallery.PICTURES / f"{name}.png"
    assert path.stat().st_size <= gallery.MOST_BYTES
    with Image.open(path) as picture:
        assert 300 < picture.width <= gallery.WIDTHS[0]
        assert sum(count > 0 for count in picture.convert("L").histogram()) > 8


def test_all_pictures_together_are_no_burden_of_the_repository():
    assert sum(path.stat().st_size for path in gallery.PICTURES.iterdir()) <= 1_000_000


def test_every_how_to_has_a_picture_with_a_sentence_and_a_link_or_a_reason():
    howtos = {path.stem for path in gallery.HOWTOS.glob("*.md")}
    linked = dict(re.findall(r"^### \[.+\]\(howto/(\w+)\.md\)\n\n!\[.+\]\(assets/gallery/(\w+)\.png\)", PAGE, re.M))
    assert all(howto == picture for howto, picture in linked.items())
    assert linked.keys() | gallery.WITHOUT.keys() == howtos
    assert not linked.keys() & gallery.WITHOUT.keys()
    assert all(gallery.WITHOUT.values())
    blocks = re.findall(r"\.png\)\{ width=\"560\" \}\n\n(.+?)\n(?=\n#|\Z)", PAGE, re.S)
    assert len(blocks) == len(SHOWN)
    assert all(block.count(". ") == 0 and block.endswith(".") for block in blocks)


def test_every_example_has_a_picture():
    assert EXAMPLES.keys() <= gallery.MAKERS.keys()
