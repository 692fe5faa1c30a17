# A test compares these files with the rows of `apertura.formats.export.EXPORTS`.
rule export:
    input:
        image="results/{flight}/{pair}/image.manifest.json",
        assessment="results/{flight}/assessment.manifest.json",
        scene="results/scene.manifest.json",
        layers="results/{flight}/{pair}/layers.manifest.json",
    output:
        "results/{flight}/{pair}/image.json",
        "results/{flight}/{pair}/ceos_ard.json",
        "results/{flight}/{pair}/ceos_ard.html",
        "results/{flight}/{pair}/slc.tif",
        "results/{flight}/{pair}/power.tif",
        "results/{flight}/{pair}/power.qml",
        "results/{flight}/{pair}/db.tif",
        "results/{flight}/{pair}/db.qml",
        report(
            "results/{flight}/{pair}/quicklook.png",
            caption="../report/quicklook.rst",
            category="{flight}",
            labels={"image": "{pair}", "shows": "image"},
        ),
        added_files("export"),
        "results/{flight}/{pair}/export.manifest.json",
    log:
        "results/logs/{flight}/{pair}.export.log",
    benchmark:
        "results/benchmarks/{flight}/{pair}.export.tsv"
    conda:
        "../../environment.yml"
    threads: job["export"].threads
    resources:
        **job["export"].resources,
    params:
        **job["export"].params,
    message:
        "{wildcards.flight}: writing the products of {wildcards.pair}"
    shell:
        "apertura step export {wildcards.flight} {wildcards.pair} --threads {threads} > {log} 2>&1"


# Made on demand, because the file is as large as the echo: request the file, or rule phase_history for all pairs.
rule cphd:
    input:
        echo="results/{flight}/{pair}/echo.manifest.json",
        profile="results/{flight}/{pair}/profile.manifest.json",
        scene="results/scene.manifest.json",
    output:
        "results/{flight}/{pair}/phase_history.cphd",
        "results/{flight}/{pair}/cphd.manifest.json",
    log:
        "results/logs/{flight}/{pair}.cphd.log",
    benchmark:
        "results/benchmarks/{flight}/{pair}.cphd.tsv"
    conda:
        "../../environment.yml"
    threads: job["cphd"].threads
    resources:
        **job["cphd"].resources,
    params:
        **job["cphd"].params,
    message:
        "{wildcards.flight}: writing the phase history of {wildcards.pair}"
    shell:
        "apertura step cphd {wildcards.flight} {wildcards.pair} > {log} 2>&1"


rule export_fused:
    input:
        image=each("results/{flight}/{pair}/image.manifest.json"),
        assessment="results/{flight}/assessment.manifest.json",
        scene="results/scene.manifest.json",
        layers=each("results/{flight}/{pair}/layers.manifest.json"),
    output:
        "results/{flight}/fused/image.json",
        "results/{flight}/fused/ceos_ard.json",
        "results/{flight}/fused/ceos_ard.html",
        "results/{flight}/fused/coherent_slc.tif",
        "results/{flight}/fused/coherent_power.tif",
        "results/{flight}/fused/coherent_power.qml",
        "results/{flight}/fused/coherent_db.tif",
        "results/{flight}/fused/coherent_db.qml",
        "results/{flight}/fused/noncoherent_power.tif",
        "results/{flight}/fused/noncoherent_power.qml",
        "results/{flight}/fused/noncoherent_db.tif",
        "results/{flight}/fused/noncoherent_db.qml",
        "results/{flight}/fused/noncoherent_magnitude.tif",
        "results/{flight}/fused/noncoherent_magnitude.qml",
        report(
            "results/{flight}/fused/quicklook.png",
            caption="../report/quicklook.rst",
            category="{flight}",
            labels={"image": "fused", "shows": "image"},
        ),
        added_files("export_fused"),
        "results/{flight}/fused/export.manifest.json",
    log:
        "results/logs/{flight}/fused.export_fused.log",
    benchmark:
        "results/benchmarks/{flight}/fused.export_fused.tsv"
    conda:
        "../../environment.yml"
    threads: job["export_fused"].threads
    resources:
        **job["export_fused"].resources,
    params:
        **job["export_fused"].params,
    message:
        "{wildcards.flight}: writing the sums of the pairs"
    shell:
        "apertura step export {wildcards.flight} fused --threads {threads} > {log} 2>&1"


rule coverage:
    input:
        echo=each("results/{flight}/{pair}/echo.manifest.json"),
        layers=each("results/{flight}/{pair}/layers.manifest.json"),
        scene="results/scene.manifest.json",
    output:
        "results/coverage.geojson",
        report("results/coverage.png", caption="../report/coverage.rst", category="campaign"),
        "results/coverage.manifest.json",
    log:
        "results/logs/coverage.log",
    benchmark:
        "results/benchmarks/coverage.tsv"
    conda:
        "../../environment.yml"
    threads: job["coverage"].threads
    resources:
        **job["coverage"].resources,
    params:
        **job["coverage"].params,
    message:
        "drawing the coverage of the flights"
    shell:
        "apertura step coverage > {log} 2>&1"


rule mosaic:
    input:
        layers=each("results/{flight}/{pair}/layers.manifest.json"),
        export=each("results/{flight}/{pair}/export.manifest.json"),
        fused=each("results/{flight}/fused/export.manifest.json"),
    output:
        [f"results/{file}" for file in mosaic_files(campaign.images, campaign.coefficients)],
        "results/mosaic/mosaic.manifest.json",
    log:
        "results/logs/mosaic.log",
    benchmark:
        "results/benchmarks/mosaic.tsv"
    conda:
        "../../environment.yml"
    threads: job["mosaic"].threads
    resources:
        **job["mosaic"].resources,
    params:
        **job["mosaic"].params,
    message:
        "writing mosaics of all flights"
    shell:
        "apertura step mosaic > {log} 2>&1"


rule map:
    input:
        layers=each("results/{flight}/{pair}/layers.manifest.json"),
        export=each("results/{flight}/{pair}/export.manifest.json"),
        fused=each("results/{flight}/fused/export.manifest.json"),
        coverage="results/coverage.manifest.json",
        scene="results/scene.manifest.json",
        change=each("results/stack/{flight}/change.manifest.json"),
        interferogram=each("results/interferometry/{two}/interferogram.manifest.json"),
        truth=files(inputs.truth),
    output:
        "results/map/map.json",
        "results/map/map.manifest.json",
    log:
        "results/logs/map.log",
    benchmark:
        "results/benchmarks/map.tsv"
    conda:
        "../../environment.yml"
    threads: job["map"].threads
    resources:
        **job["map"].resources,
    params:
        **job["map"].params,
    message:
        "writing the data of the map"
    shell:
        "apertura step map > {log} 2>&1"
