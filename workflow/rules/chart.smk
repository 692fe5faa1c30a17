rule speed_accuracy:
    input:
        [
            campaign.manifest(stage, campaign.image_flights[0].name, campaign.image_flights[0].pairs[-1])
            for stage in ("echo", "profile")
        ],
        "results/scene.json",
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
