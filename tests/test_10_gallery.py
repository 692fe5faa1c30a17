"""The gallery shows a picture of every how-to and every example, each small, and made by one script."""

import re

import gallery
import numpy as np
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


@pytest.mark.parametrize(("cell", "mode"), [(66, "RGB"), (12, "P")])
def test_a_picture_keeps_all_its_colours_where_it_stays_below_the_limit(monkeypatch, tmp_path, cell, mode):
    """Cells of random colours: 60 of them fit into 60 kB as they are, 1815 do not."""
    monkeypatch.setattr(gallery, "PICTURES", tmp_path)
    colours = np.random.default_rng(1).integers(0, 256, (396 // cell, 660 // cell, 3), np.uint8)
    drawn = Image.fromarray(colours).resize((1320, 792), Image.Resampling.NEAREST)
    drawn.save(tmp_path / "drawn.png")
    gallery.publish(tmp_path / "drawn.png", "shown")
    assert (tmp_path / "shown.png").stat().st_size <= gallery.MOST_BYTES
    with Image.open(tmp_path / "shown.png") as shown:
        assert shown.mode == mode
        if mode == "RGB":
            assert shown.size == (660, 396)
            assert len(shown.getcolors(1 << 20)) > 1000


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
