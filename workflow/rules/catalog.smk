rule stac:
    input:
        echo=each("results/{flight}/{pair}/echo.manifest.json"),
        layers=each("results/{flight}/{pair}/layers.manifest.json"),
        export=each("results/{flight}/{pair}/export.manifest.json"),
        fused=each("results/{flight}/fused/export.manifest.json"),
        scene="results/scene.manifest.json",
        interferogram=each("results/interferometry/{two}/interferogram.manifest.json"),
    output:
        "results/stac/catalog.json",
        "results/stac.manifest.json",
    log:
        "results/logs/stac.log",
    benchmark:
        "results/benchmarks/stac.tsv"
    conda:
        "../../environment.yml"
    threads: job["stac"].threads
    resources:
        **job["stac"].resources,
    params:
        **job["stac"].params,
    message:
        "writing the STAC catalogue of all images"
    shell:
        "apertura step stac > {log} 2>&1"


# The last rule, because it describes all other results.
rule ro_crate:
    input:
        config=files(inputs.config_files),
        results=files(every_result),
    output:
        "results/ro-crate-metadata.json",
        "results/ro_crate.manifest.json",
    log:
        "results/logs/ro_crate.log",
    benchmark:
        "results/benchmarks/ro_crate.tsv"
    conda:
        "../../environment.yml"
    threads: job["ro_crate"].threads
    resources:
        **job["ro_crate"].resources,
    params:
        **job["ro_crate"].params,
    message:
        "writing the RO-Crate of the run"
    shell:
        "apertura step ro-crate > {log} 2>&1"
