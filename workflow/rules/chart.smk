rule speed_accuracy:
    input:
        header["speed_accuracy"].sources,
    output:
        [
            report(file, caption="../report/speed_accuracy.rst", category="study")
            for file in header["speed_accuracy"].pictured
        ],
        header["speed_accuracy"].output,
    log:
        header["speed_accuracy"].log,
    benchmark:
        header["speed_accuracy"].benchmark
    conda:
        "../../environment.yml"
    threads: header["speed_accuracy"].threads
    resources:
        mem_mb=header["speed_accuracy"].mem_mb,
        runtime=header["speed_accuracy"].runtime,
    params:
        settings=header["speed_accuracy"].settings,
        code=header["speed_accuracy"].code,
        charted=lambda _: " ".join(charted(campaign)),
    message:
        "timing and measuring every engine and setting"
    shell:
        "apertura step chart {params.charted} > {log} 2>&1"


# Everything from raw samples on, under several settings: works in results/study/whole, which it removes.
rule whole_chart:
    input:
        header["whole_chart"].sources,
    output:
        [report(file, caption="../report/whole.rst", category="study") for file in header["whole_chart"].pictured],
        header["whole_chart"].output,
    log:
        header["whole_chart"].log,
    benchmark:
        header["whole_chart"].benchmark
    conda:
        "../../environment.yml"
    threads: header["whole_chart"].threads
    resources:
        mem_mb=header["whole_chart"].mem_mb,
        runtime=header["whole_chart"].runtime,
    params:
        settings=header["whole_chart"].settings,
        code=header["whole_chart"].code,
    message:
        "timing the way from raw samples to GeoTIFFs under several settings"
    shell:
        "apertura step whole-chart > {log} 2>&1"
