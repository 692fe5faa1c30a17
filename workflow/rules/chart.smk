rule speed_accuracy:
    input:
        [
            campaign.manifest(stage, campaign.image_flights[0].name, campaign.image_flights[0].pairs[-1])
            for stage in ("echo", "profile")
        ],
        "results/scene.manifest.json",
    output:
        "results/study/speed_accuracy.csv",
        report(
            "results/study/speed_accuracy.png",
            caption="../report/speed_accuracy.rst",
            category="study",
        ),
        "results/study/speed_accuracy.html",
    log:
        "results/logs/study/speed_accuracy.log",
    benchmark:
        "results/benchmarks/study/speed_accuracy.tsv"
    conda:
        "../../environment.yml"
    threads: 1
    resources:
        mem_mb=lambda wildcards, attempt: 3000 * attempt,
    params:
        code=code_sha256("apertura.study.chart.speed_accuracy"),
        flight=campaign.image_flights[0].name,
        pair=campaign.image_flights[0].pairs[-1],
    message:
        "timing and measuring every engine and setting"
    shell:
        "apertura step chart {params.flight} {params.pair} > {log} 2>&1"


# Everything from raw samples on, under several settings: works in results/study/whole, which it removes.
rule whole_chart:
    input:
        [
            path
            for flight in campaign.flights
            for node in flight.nodes
            for path in campaign.raw_files(flight.name, node).values()
        ],
        list(campaign.height_files().values()),
    output:
        "results/study/whole.csv",
        report("results/study/whole.png", caption="../report/whole.rst", category="study"),
    log:
        "results/logs/study/whole.log",
    benchmark:
        "results/benchmarks/study/whole.tsv"
    conda:
        "../../environment.yml"
    threads: 1
    resources:
        mem_mb=lambda wildcards, attempt: 3000 * attempt,
    params:
        settings=campaign.relevant("image", campaign.image_flights[0].pairs[-1]),
        code=code_sha256("apertura.study.chart.whole"),
    message:
        "timing the way from raw samples to GeoTIFFs under several settings"
    shell:
        "apertura step whole-chart > {log} 2>&1"
