rule stac:
    input:
        header["stac"].sources,
    output:
        header["stac"].output,
    log:
        header["stac"].log,
    benchmark:
        header["stac"].benchmark
    conda:
        "../../environment.yml"
    threads: header["stac"].threads
    resources:
        mem_mb=header["stac"].mem_mb,
        runtime=header["stac"].runtime,
    params:
        settings=header["stac"].settings,
        code=header["stac"].code,
    message:
        "describing every image in a catalog"
    shell:
        "apertura step stac > {log} 2>&1"


# Last of all: it describes every other result.
rule ro_crate:
    input:
        header["ro_crate"].sources,
    output:
        header["ro_crate"].output,
    log:
        header["ro_crate"].log,
    benchmark:
        header["ro_crate"].benchmark
    conda:
        "../../environment.yml"
    threads: header["ro_crate"].threads
    resources:
        mem_mb=header["ro_crate"].mem_mb,
        runtime=header["ro_crate"].runtime,
    params:
        settings=header["ro_crate"].settings,
        code=header["ro_crate"].code,
    message:
        "describing the whole run as an RO-Crate"
    shell:
        "apertura step ro-crate > {log} 2>&1"
