rule speed_accuracy:
    input:
        lambda wildcards: result_of(campaign, "speed_accuracy").sources,
    output:
        "results/study/speed_accuracy.csv",
        report(
            "results/study/speed_accuracy.png",
            caption="../report/speed_accuracy.rst",
            category="study",
        ),
        "results/study/speed_accuracy.html",
        "results/study/speed_accuracy.manifest.json",
    log:
        "results/logs/study/speed_accuracy.log",
    benchmark:
        "results/benchmarks/study/speed_accuracy.tsv"
    conda:
        "../../environment.yml"
    threads: asked["speed_accuracy"].threads
    resources:
        mem_mb=asked["speed_accuracy"].mem_mb,
        runtime=asked["speed_accuracy"].runtime,
    params:
        code=lambda _: result_of(campaign, "speed_accuracy").code_sha256,
        charted=" ".join(charted(campaign)),
    message:
        "timing and measuring every engine and setting"
    shell:
        "apertura step chart {params.charted} > {log} 2>&1"


# Everything from raw samples on, under several settings: works in results/study/whole, which it removes.
rule whole_chart:
    input:
        lambda wildcards: result_of(campaign, "whole").sources,
    output:
        "results/study/whole.csv",
        report("results/study/whole.png", caption="../report/whole.rst", category="study"),
        "results/study/whole.manifest.json",
    log:
        "results/logs/study/whole.log",
    benchmark:
        "results/benchmarks/study/whole.tsv"
    conda:
        "../../environment.yml"
    threads: asked["whole_chart"].threads
    resources:
        mem_mb=asked["whole_chart"].mem_mb,
        runtime=asked["whole_chart"].runtime,
    params:
        settings=lambda _: campaign.values,
        code=lambda _: result_of(campaign, "whole").code_sha256,
    message:
        "timing the way from raw samples to GeoTIFFs under several settings"
    shell:
        "apertura step whole-chart > {log} 2>&1"
