rule interferogram:
    input:
        echo=each("results/{flight}/{pair}/echo.manifest.json"),
        profile=each("results/{flight}/{pair}/profile.manifest.json"),
        scene="results/scene.manifest.json",
        terrain=each("results/terrain.manifest.json"),
        patterns=files(inputs.patterns),
        image=each("results/{flight}/{pair}/image.manifest.json"),
        layers=each("results/{flight}/{pair}/layers.manifest.json"),
    output:
        "results/interferometry/{two}/interferogram.json",
        "results/interferometry/{two}/phase.tif",
        "results/interferometry/{two}/phase.qml",
        "results/interferometry/{two}/coherence.tif",
        "results/interferometry/{two}/coherence.qml",
        "results/interferometry/{two}/unwrapped.tif",
        "results/interferometry/{two}/unwrapped.qml",
        "results/interferometry/{two}/height.tif",
        "results/interferometry/{two}/height.qml",
        "results/interferometry/{two}/height_std.tif",
        "results/interferometry/{two}/height_std.qml",
        report(
            "results/interferometry/{two}/quicklook.png",
            caption="../report/interferogram.rst",
            category="interferometry",
            labels={"image": "{two}"},
        ),
        added_files("interferogram"),
        "results/interferometry/{two}/interferogram.manifest.json",
    log:
        "results/logs/interferometry/{two}.interferogram.log",
    benchmark:
        "results/benchmarks/interferometry/{two}.interferogram.tsv"
    conda:
        "../../environment.yml"
    threads: job["interferogram"].threads
    resources:
        **job["interferogram"].resources,
    params:
        **job["interferogram"].params,
    message:
        "{wildcards.two}: forming the interferogram"
    shell:
        "apertura step interferogram {wildcards.two} > {log} 2>&1"
