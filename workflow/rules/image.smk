# Tiles of one image are formed by so many jobs: --set-scatter tiles=8, or `set-scatter: tiles=8` in a profile.
scattergather:
    tiles=1,


rule scene:
    input:
        header["scene"].sources,
    output:
        header["scene"].output,
    log:
        header["scene"].log,
    benchmark:
        header["scene"].benchmark
    conda:
        "../../environment.yml"
    threads: header["scene"].threads
    resources:
        mem_mb=header["scene"].mem_mb,
        runtime=header["scene"].runtime,
    params:
        settings=header["scene"].settings,
        code=header["scene"].code,
    message:
        "choosing the campaign's grid"
    shell:
        "apertura step scene > {log} 2>&1"


rule terrain:
    input:
        header["terrain"].sources,
    output:
        header["terrain"].output,
    log:
        header["terrain"].log,
    benchmark:
        header["terrain"].benchmark
    conda:
        "../../environment.yml"
    threads: header["terrain"].threads
    resources:
        mem_mb=header["terrain"].mem_mb,
        runtime=header["terrain"].runtime,
    params:
        settings=header["terrain"].settings,
        code=header["terrain"].code,
    message:
        "resampling the DEM to the campaign's grid"
    shell:
        "apertura step terrain > {log} 2>&1"


rule layers:
    input:
        header["layers"].sources,
    output:
        header["layers"].output,
    log:
        header["layers"].log,
    benchmark:
        header["layers"].benchmark
    priority: 1  # before images, which take all cores: what rasters take on this machine is then known early
    conda:
        "../../environment.yml"
    threads: header["layers"].threads
    resources:
        mem_mb=header["layers"].mem_mb,
        runtime=header["layers"].runtime,
    params:
        settings=header["layers"].settings,
        code=header["layers"].code,
    message:
        "{wildcards.flight}: angles, mask, looks and noise of {wildcards.pair}"
    shell:
        "apertura step layers {wildcards.flight} {wildcards.pair} --threads {threads} > {log} 2>&1"


rule refine:
    input:
        header["refine"].sources,
    output:
        header["refine"].output,
    log:
        header["refine"].log,
    benchmark:
        header["refine"].benchmark
    conda:
        "../../environment.yml"
    threads: header["refine"].threads
    resources:
        mem_mb=header["refine"].mem_mb,
        runtime=header["refine"].runtime,
    params:
        settings=header["refine"].settings,
        code=header["refine"].code,
    message:
        "{wildcards.flight}: refining the tracks of its nodes where that pays"
    shell:
        "apertura step refine {wildcards.flight} > {log} 2>&1"


rule tracks:
    input:
        header["tracks"].sources,
    output:
        [
            report(
                file, caption="../report/tracks.rst", category="{flight}", labels={"image": "all", "shows": "tracks"}
            )
            for file in header["tracks"].pictured
        ],
        header["tracks"].output,
    log:
        header["tracks"].log,
    benchmark:
        header["tracks"].benchmark
    conda:
        "../../environment.yml"
    threads: header["tracks"].threads
    resources:
        mem_mb=header["tracks"].mem_mb,
        runtime=header["tracks"].runtime,
    params:
        settings=header["tracks"].settings,
        code=header["tracks"].code,
    message:
        "{wildcards.flight}: writing the tracks as refined"
    shell:
        "apertura step tracks {wildcards.flight} > {log} 2>&1"


rule tiles:
    input:
        header["tiles"].sources,
    output:
        temp("results/{flight}/{pair}/tiles/{scatteritem}.json"),
    log:
        "results/logs/{flight}/{pair}.tiles.{scatteritem}.log",
    benchmark:
        "results/benchmarks/{flight}/{pair}.tiles.{scatteritem}.tsv"
    conda:
        "../../environment.yml"
    threads: header["tiles"].threads
    resources:
        mem_mb=header["tiles"].mem_mb,
        runtime=header["tiles"].runtime,
    params:
        settings=header["tiles"].settings,
        code=header["tiles"].code,
    message:
        "{wildcards.flight}: share {wildcards.scatteritem} of the tiles of {wildcards.pair}"
    shell:
        "apertura step tiles {wildcards.flight} {wildcards.pair} {wildcards.scatteritem} --threads {threads} > {log} 2>&1"


# One job alone forms the tiles and finishes the image; the shares of many are gathered.
rule image:
    input:
        header["image"].sources,
        [
            share
            for share in gather.tiles("results/{{flight}}/{{pair}}/tiles/{scatteritem}.json")
            if "-of-1." not in share
        ],
    output:
        header["image"].output,
    log:
        header["image"].log,
    benchmark:
        header["image"].benchmark
    conda:
        "../../environment.yml"
    threads: header["image"].threads
    resources:
        mem_mb=header["image"].mem_mb,
        runtime=header["image"].runtime,
    params:
        settings=header["image"].settings,
        code=header["image"].code,
    message:
        "{wildcards.flight}: focusing {wildcards.pair} with {threads} threads"
    shell:
        "apertura step image {wildcards.flight} {wildcards.pair} --threads {threads} > {log} 2>&1"


rule assess:
    input:
        header["assess"].sources,
    output:
        header["assess"].output,
    log:
        header["assess"].log,
    benchmark:
        header["assess"].benchmark
    conda:
        "../../environment.yml"
    threads: header["assess"].threads
    resources:
        mem_mb=header["assess"].mem_mb,
        runtime=header["assess"].runtime,
    params:
        settings=header["assess"].settings,
        code=header["assess"].code,
    message:
        "{wildcards.flight}: comparing the images with each other"
    shell:
        "apertura step assess {wildcards.flight} > {log} 2>&1"
