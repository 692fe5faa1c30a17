rule cube:
    input:
        header["cube"].sources,
    output:
        header["cube"].output,
    log:
        header["cube"].log,
    benchmark:
        header["cube"].benchmark
    conda:
        "../../environment.yml"
    threads: header["cube"].threads
    resources:
        mem_mb=header["cube"].mem_mb,
        runtime=header["cube"].runtime,
    params:
        settings=header["cube"].settings,
        code=header["cube"].code,
    message:
        "stacking and adding up every image"
    shell:
        "apertura step cube --threads {threads} > {log} 2>&1"
