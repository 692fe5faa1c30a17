"""Render the recipe for Linux on x86-64 and aarch64 with rattler-build; unknown keys and templates are errors."""

from pathlib import Path

from rattler_build import PlatformConfig, RenderConfig, Stage0Recipe, VariantConfig

VARIANTS = {"cxx_compiler": ["gxx"], "c_stdlib": ["sysroot"], "c_stdlib_version": ["2.17"]}  # of conda-forge

for platform in ("linux-64", "linux-aarch64"):
    recipe = Stage0Recipe.from_file(Path(__file__).with_name("recipe.yaml"))
    config = RenderConfig(
        platform=PlatformConfig(target_platform=platform, build_platform="linux-64", host_platform=platform)
    )
    for variant in recipe.render(VariantConfig(VARIANTS), config):
        print(platform, variant)
