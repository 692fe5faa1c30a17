"""The site contains every page of docs/, typesets equations but not names, and loads nothing from other hosts."""

import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from website.check import faults
from website.equations import set_equations
from website.outside import OUTSIDE

ROOT = Path(__file__).parents[1]
CHROMIUM = Path("/usr/bin/chromium")


def leaves(node):
    if isinstance(node, str):
        yield node
    else:
        for child in node.values() if isinstance(node, dict) else node:
            yield from leaves(child)


def test_every_page_is_in_the_navigation_once():
    nav = list(leaves(yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))["nav"]))
    pages = [path.relative_to(ROOT / "docs").as_posix() for path in ROOT.glob("docs/**/*.md")]
    assert sorted(nav) == sorted([*pages, *OUTSIDE.values()])


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("Σ_m w_n H_{m,n}", "Σ<sub>m</sub> w<sub>n</sub> H<sub>m,n</sub>"),
        ("exp(+j2πf_mid ρ/c)", "exp(+j2πf<sub>mid</sub> ρ/c)"),
        ("f_b²π, x_tx,m, (Dm)_i", "f<sub>b</sub>²π, x<sub>tx,m</sub>, (Dm)<sub>i</sub>"),
        ("c_cT", "c<sub>c</sub>T"),
        (
            "max_x ½ mean_m r, 1/SNR_p, ∂_ξ R",
            "max<sub>x</sub> ½ mean<sub>m</sub> r, 1/SNR<sub>p</sub>, ∂<sub>ξ</sub> R",
        ),
        ("10^(−L/20), u^d, P^(1/(L−1))", "10<sup>−L/20</sup>, u<sup>d</sup>, P<sup>1/(L−1)</sup>"),
        ("GPS_DELAY, start_s, two_parameter", "GPS_DELAY, start_s, two_parameter"),
        ('<a href="w_n.md">p_i</a> <code>w_n</code>', '<a href="w_n.md">p<sub>i</sub></a> <code>w_n</code>'),
    ],
)
def test_indices_and_powers_are_typeset_but_names_are_not(text, shown):
    assert set_equations(text) == shown


def block(text):
    return f'<div class="highlight"><pre><span></span><code>{text}\n</code></pre></div>'


def test_indented_equation_is_typeset_and_table_is_unchanged():
    assert set_equations(block("y = x_n        (4a)")) == (
        '<pre class="equation">y = x<sub>n</sub><span class="number">(4a)</span></pre>'
    )
    table = block("a_b    one\nc_d    two")
    assert set_equations(table) == table


def write(site, body, css=""):
    site.mkdir(exist_ok=True)
    (site / "index.html").write_text(f'<h2 id="here">a</h2>{body}', encoding="utf-8")
    (site / "site.css").write_text(css, encoding="utf-8")
    return [fault.removeprefix(f"{site}/index.html: ") for fault in faults(site)]


def test_dead_links_and_external_resources_are_reported(tmp_path):
    site = tmp_path / "site"
    assert write(site, '<a href="#here">a</a><a href="https://a.example/">b</a><link href="site.css">') == []
    assert write(site, '<a href="gone.html">a</a>') == ["gone.html: target does not exist"]
    assert write(site, '<a href="index.html#there">a</a>') == ["index.html#there: heading does not exist"]
    for loaded in ('<script src="https://a.example/x.js">', '<img src="//a.example/x.png">'):
        assert len(write(site, loaded)) == 1
    assert len(write(site, "", css='@import url("https://a.example/font.css")')) == 1


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The site, built in the same way as by `make docs`."""
    site = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--site-dir", str(site)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return site


@pytest.mark.slow
def test_site_builds_without_warnings_or_dead_links(site):
    assert faults(site) == []


@pytest.mark.slow
@pytest.mark.skipif(not CHROMIUM.exists(), reason="no /usr/bin/chromium")
def test_search_works_on_pages_opened_from_disk(site):
    with pytest.importorskip("playwright.sync_api").sync_playwright() as tool:
        browser = tool.chromium.launch(executable_path=CHROMIUM, headless=True, args=["--no-sandbox"])
        page = browser.new_page()
        page.goto((site / "theory/focus.html").as_uri())
        page.fill("input.md-search__input", "spectrum_inverted")
        page.wait_for_selector(".md-search-result__item a[href*='flags.html']", timeout=20_000)
        browser.close()
