"""Image on the first page: `python -m website.picture` forms docs/assets/image.png from simulated echoes."""

from pathlib import Path

import numpy as np
from PIL import Image
from rasterio import Affine

import apertura as ap
from apertura.formats.export.quicklook import write_quicklook

PICTURE = Path(__file__).parents[1] / "docs" / "assets" / "image.png"


def example_history() -> ap.PhaseHistory:
    """Return echoes of nine posts in two rows and of rough terrain, for a flight of 40 m at 60 m south of the posts."""
    generator, frequency = np.random.default_rng(29), 1.2e9 + 1.6e6 * np.arange(256)
    posts = np.array([[x, y, 0.0] for y, count in ((-4.0, 5), (5.0, 4)) for x in np.linspace(-9, 9, count)])
    rough = np.column_stack([generator.uniform(-15, 15, (900, 2)), np.zeros(900)])
    scattered = 0.06 * (generator.standard_normal((2, 900)) * [[1], [1j]]).sum(axis=0)
    along = np.linspace(-20, 20, 500)
    track = np.column_stack([along, -60 + 0.4 * np.sin(along / 5), np.full(500, 30.0)])
    aperture, echo = ap.Aperture(track, track), np.zeros((500, 256), np.complex128)
    for point, amplitude in zip(np.concatenate([posts, rough]), [*np.ones(len(posts)), *scattered], strict=True):
        echo += amplitude * np.exp(-2j * np.pi * frequency * aperture.path(point[None]) / 299792458.0)
    window = np.hanning(258)[1:-1]
    return ap.PhaseHistory(echo.astype(np.complex64), frequency, window / window.sum(), np.zeros(500), aperture)


def main() -> None:
    """Form the image and write it as a quicklook."""
    grid = ap.SceneGrid("local", -14.0, 10.0, 0.05, (400, 560))
    image = ap.backproject(example_history(), grid)
    tags = {"APERTURA_VERSION": ap.__version__, "APERTURA_ERROR_DB": f"{image.numerical_error_db:.0f}"}
    title = f"nine posts on rough ground: {image.verdict}"
    write_quicklook(PICTURE, image.values, transform=Affine(*grid.transform), crs=grid.crs_wkt, tags=tags, title=title)
    with Image.open(PICTURE) as drawn:  # reduce the size of 400 kB, which is too large for a web page
        small = drawn.convert("RGB").resize((drawn.width // 2, drawn.height // 2), Image.Resampling.LANCZOS)
    small.quantize(64).save(PICTURE, optimize=True)


if __name__ == "__main__":
    main()
