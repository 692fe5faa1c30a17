rule stack_image:
    input:
        echo=each("results/{flight}/{pair}/echo.manifest.json", STACKED),
        profile=each("results/{flight}/{pair}/profile.manifest.json", STACKED),
        scene="results/scene.manifest.json",
        terrain=each("results/terrain.manifest.json", STACKED),
        patterns=files(inputs.patterns, STACKED),
        refined_track=each("results/{flight}/refined_track.manifest.json", STACKED),
        image=each("results/{flight}/{pair}/image.manifest.json", STACKED),
        layers=each("results/{flight}/{pair}/layers.manifest.json", STACKED),
    output:
        "results/stack/{flight}/stack.json",
        "results/stack/{flight}/slc.tif",
        "results/stack/{flight}/phase_flattened.tif",
        "results/stack/{flight}/phase_flattened.qml",
        "results/stack/{flight}/residual_phase.tif",
        "results/stack/{flight}/residual_phase.qml",
        "results/stack/{flight}/coherence.tif",
        "results/stack/{flight}/coherence.qml",
        "results/stack/{flight}/expected_coherence.tif",
        "results/stack/{flight}/expected_coherence.qml",
        "results/stack/{flight}/line_of_sight_enu.tif",
        "results/stack/{flight}/slant_range_distance.tif",
        added_files("stack_image"),
        "results/stack/{flight}/stack_image.manifest.json",
    log:
        "results/logs/stack/{flight}.stack_image.log",
    benchmark:
        "results/benchmarks/stack/{flight}.stack_image.tsv"
    conda:
        "../../environment.yml"
    threads: job["stack_image"].threads
    resources:
        **job["stack_image"].resources,
    params:
        **job["stack_image"].params,
    message:
        "{wildcards.flight}: referring the image to the reference flight of the stack"
    shell:
        "apertura step stack-image {wildcards.flight} > {log} 2>&1"


rule stack:
    input:
        stack_image=each("results/stack/{flight}/stack_image.manifest.json"),
    output:
        "results/stack/stack.json",
        "results/stack/baselines.csv",
        "results/stack/stack.manifest.json",
    log:
        "results/logs/stack.log",
    benchmark:
        "results/benchmarks/stack.tsv"
    conda:
        "../../environment.yml"
    threads: job["stack"].threads
    resources:
        **job["stack"].resources,
    params:
        **job["stack"].params,
    message:
        "listing the baselines of the stack"
    shell:
        "apertura step stack > {log} 2>&1"


rule change:
    input:
        stack_image="results/stack/{flight}/stack_image.manifest.json",
        reference=files(inputs.stack_reference, STACKED),
        image=each("results/{flight}/{pair}/image.manifest.json", STACKED),
        scene="results/scene.manifest.json",
    output:
        "results/stack/{flight}/change.json",
        "results/stack/{flight}/amplitude_ratio.tif",
        "results/stack/{flight}/amplitude_ratio.qml",
        "results/stack/{flight}/coherence_loss.tif",
        "results/stack/{flight}/coherence_loss.qml",
        "results/stack/{flight}/change.tif",
        "results/stack/{flight}/change.qml",
        "results/stack/{flight}/change_regions.gpkg",
        report(
            "results/stack/{flight}/change.png",
            caption="../report/change.rst",
            category="changes",
            labels={"flight": "{flight}"},
        ),
        added_files("change"),
        "results/stack/{flight}/change.manifest.json",
    log:
        "results/logs/stack/{flight}.change.log",
    benchmark:
        "results/benchmarks/stack/{flight}.change.tsv"
    conda:
        "../../environment.yml"
    threads: job["change"].threads
    resources:
        **job["change"].resources,
    params:
        **job["change"].params,
    message:
        "{wildcards.flight}: detecting changes relative to the reference flight of the stack"
    shell:
        "apertura step change {wildcards.flight} > {log} 2>&1"
