rule interferogram:
    input:
        header["interferogram"].sources,
    output:
        [
            report(
                file,
                caption="../report/interferogram.rst",
                category="interferometry",
                labels={"image": "{two}"},
            )
            for file in header["interferogram"].pictured
        ],
        header["interferogram"].output,
    log:
        header["interferogram"].log,
    benchmark:
        header["interferogram"].benchmark
    conda:
        "../../environment.yml"
    threads: header["interferogram"].threads
    resources:
        mem_mb=header["interferogram"].mem_mb,
        runtime=header["interferogram"].runtime,
    params:
        settings=header["interferogram"].settings,
        code=header["interferogram"].code,
    message:
        "{wildcards.two}: comparing two images in phase"
    shell:
        "apertura step interferogram {wildcards.two} > {log} 2>&1"
