rule speed_accuracy:
    input:
        echo=each("results/{flight}/{pair}/echo.manifest.json", of=CHARTED),
        profile=each("results/{flight}/{pair}/profile.manifest.json", of=CHARTED),
        scene="results/scene.manifest.json",
        terrain=each("results/terrain.manifest.json", of=CHARTED),
        patterns=files(inputs.patterns, of=CHARTED),
        refined_track=each("results/{flight}/refined_track.manifest.json", of=CHARTED),
    output:
        "results/study/speed_accuracy.csv",
        "results/study/speed_accuracy.html",
        report("results/study/speed_accuracy.png", caption="../report/speed_accuracy.rst", category="study"),
        "results/study/speed_accuracy.manifest.json",
    log:
        "results/logs/speed_accuracy.log",
    benchmark:
        "results/benchmarks/speed_accuracy.tsv"
    conda:
        "../../environment.yml"
    threads: job["speed_accuracy"].threads
    resources:
        **job["speed_accuracy"].resources,
    params:
        **job["speed_accuracy"].params,
        charted=lambda _: " ".join(inputs.charted(campaign)),
    message:
        "measuring run time and accuracy of every engine and setting"
    shell:
        "apertura step chart {params.charted} > {log} 2>&1"


# The whole workflow with several settings, in the temporary folder results/study/whole.
rule whole_chart:
    input:
        recordings=files(inputs.everything_recorded),
        heights=files(inputs.heights),
    output:
        "results/study/whole.csv",
        report("results/study/whole.png", caption="../report/whole.rst", category="study"),
        "results/study/whole.manifest.json",
    log:
        "results/logs/whole_chart.log",
    benchmark:
        "results/benchmarks/whole_chart.tsv"
    conda:
        "../../environment.yml"
    threads: job["whole_chart"].threads
    resources:
        **job["whole_chart"].resources,
    params:
        **job["whole_chart"].params,
    message:
        "measuring the workflow from raw samples to GeoTIFFs with several settings"
    shell:
        "apertura step whole-chart > {log} 2>&1"
