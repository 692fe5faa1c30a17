# Number of jobs that form the tiles of an image: --set-scatter tiles=8, or `set-scatter: tiles=8` in a profile.
scattergather:
    tiles=1,


rule scene:
    input:
        echo=files(inputs.echoes_that_bound_the_scene),
        heights=files(inputs.heights),
    output:
        "results/scene.json",
        "results/scene.manifest.json",
    log:
        "results/logs/scene.log",
    benchmark:
        "results/benchmarks/scene.tsv"
    conda:
        "../../environment.yml"
    threads: job["scene"].threads
    resources:
        **job["scene"].resources,
    params:
        **job["scene"].params,
    message:
        "choosing the campaign's grid"
    shell:
        "apertura step scene > {log} 2>&1"


rule terrain:
    input:
        scene="results/scene.manifest.json",
        heights=files(inputs.heights),
    output:
        "results/terrain.manifest.json",
    log:
        "results/logs/terrain.log",
    benchmark:
        "results/benchmarks/terrain.tsv"
    conda:
        "../../environment.yml"
    threads: job["terrain"].threads
    resources:
        **job["terrain"].resources,
    params:
        **job["terrain"].params,
    message:
        "resampling the DEM to the campaign's grid"
    shell:
        "apertura step terrain > {log} 2>&1"


rule layers:
    input:
        echo="results/{flight}/{pair}/echo.manifest.json",
        profile="results/{flight}/{pair}/profile.manifest.json",
        scene="results/scene.manifest.json",
        terrain=each("results/terrain.manifest.json"),
        patterns=files(inputs.patterns),
        calibrated=files(inputs.measured_image),
    output:
        "results/{flight}/{pair}/incidence.tif",
        "results/{flight}/{pair}/incidence.qml",
        "results/{flight}/{pair}/bistatic_angle.tif",
        "results/{flight}/{pair}/bistatic_angle.qml",
        "results/{flight}/{pair}/mask.tif",
        "results/{flight}/{pair}/mask.qml",
        "results/{flight}/{pair}/looks.tif",
        "results/{flight}/{pair}/looks.qml",
        "results/{flight}/{pair}/nesz.tif",
        "results/{flight}/{pair}/nesz.qml",
        added_files("layers"),
        "results/{flight}/{pair}/layers.manifest.json",
    log:
        "results/logs/{flight}/{pair}.layers.log",
    benchmark:
        "results/benchmarks/{flight}/{pair}.layers.tsv"
    priority: 1  # before images, which use all cores, so that the speed of raster steps is measured early
    conda:
        "../../environment.yml"
    threads: job["layers"].threads
    resources:
        **job["layers"].resources,
    params:
        **job["layers"].params,
    message:
        "{wildcards.flight}: computing angles, mask, looks and noise of {wildcards.pair}"
    shell:
        "apertura step layers {wildcards.flight} {wildcards.pair} --threads {threads} > {log} 2>&1"


rule refine:
    input:
        echo_and_profile=files(inputs.autofocused),
        scene="results/scene.manifest.json",
        terrain=each("results/terrain.manifest.json"),
    output:
        "results/{flight}/refined_track.manifest.json",
    log:
        "results/logs/{flight}/refine.log",
    benchmark:
        "results/benchmarks/{flight}/refine.tsv"
    conda:
        "../../environment.yml"
    threads: job["refine"].threads
    resources:
        **job["refine"].resources,
    params:
        **job["refine"].params,
    message:
        "{wildcards.flight}: refining the tracks of its nodes if autofocus is on"
    shell:
        "apertura step refine {wildcards.flight} > {log} 2>&1"


rule tracks:
    input:
        refined_track="results/{flight}/refined_track.manifest.json",
        track=each("results/{flight}/{node}/track.manifest.json"),
        positions=files(inputs.unstaged_positions),
    output:
        report(
            "results/{flight}/tracks/tracks.png",
            caption="../report/tracks.rst",
            category="{flight}",
            labels={"image": "all", "shows": "tracks"},
        ),
        "results/{flight}/tracks/tracks.manifest.json",
    log:
        "results/logs/{flight}/tracks.tracks.log",
    benchmark:
        "results/benchmarks/{flight}/tracks.tracks.tsv"
    conda:
        "../../environment.yml"
    threads: job["tracks"].threads
    resources:
        **job["tracks"].resources,
    params:
        **job["tracks"].params,
    message:
        "{wildcards.flight}: writing the refined tracks"
    shell:
        "apertura step tracks {wildcards.flight} > {log} 2>&1"


rule tiles:
    input:
        echo="results/{flight}/{pair}/echo.manifest.json",
        profile="results/{flight}/{pair}/profile.manifest.json",
        scene="results/scene.manifest.json",
        terrain=each("results/terrain.manifest.json"),
        patterns=files(inputs.patterns),
        refined_track="results/{flight}/refined_track.manifest.json",
    output:
        temp("results/{flight}/{pair}/tiles/{scatteritem}.json"),
    log:
        "results/logs/{flight}/{pair}.tiles.{scatteritem}.log",
    benchmark:
        "results/benchmarks/{flight}/{pair}.tiles.{scatteritem}.tsv"
    conda:
        "../../environment.yml"
    threads: job["tiles"].threads
    resources:
        **job["tiles"].resources,
    params:
        **job["tiles"].params,
    message:
        "{wildcards.flight}: forming share {wildcards.scatteritem} of the tiles of {wildcards.pair}"
    shell:
        "apertura step tiles {wildcards.flight} {wildcards.pair} {wildcards.scatteritem} --threads {threads} > {log} 2>&1"


# A single job forms the tiles and completes the image; the shares of several jobs are gathered.
rule image:
    input:
        echo="results/{flight}/{pair}/echo.manifest.json",
        profile="results/{flight}/{pair}/profile.manifest.json",
        scene="results/scene.manifest.json",
        terrain=each("results/terrain.manifest.json"),
        patterns=files(inputs.patterns),
        refined_track="results/{flight}/refined_track.manifest.json",
        tiles=[
            share
            for share in gather.tiles("results/{{flight}}/{{pair}}/tiles/{scatteritem}.json")
            if "-of-1." not in share
        ],
    output:
        "results/{flight}/{pair}/image.manifest.json",
    log:
        "results/logs/{flight}/{pair}.image.log",
    benchmark:
        "results/benchmarks/{flight}/{pair}.image.tsv"
    conda:
        "../../environment.yml"
    threads: job["image"].threads
    resources:
        **job["image"].resources,
    params:
        **job["image"].params,
    message:
        "{wildcards.flight}: forming the image of {wildcards.pair} with {threads} threads"
    shell:
        "apertura step image {wildcards.flight} {wildcards.pair} --threads {threads} > {log} 2>&1"


rule assess:
    input:
        echo=each("results/{flight}/{pair}/echo.manifest.json"),
        image=each("results/{flight}/{pair}/image.manifest.json"),
        refined_track="results/{flight}/refined_track.manifest.json",
        scene="results/scene.manifest.json",
        terrain=each("results/terrain.manifest.json"),
        first_flight=files(inputs.first_flight),
    output:
        "results/{flight}/assessment.json",
        "results/{flight}/assessment.manifest.json",
    log:
        "results/logs/{flight}/assess.log",
    benchmark:
        "results/benchmarks/{flight}/assess.tsv"
    conda:
        "../../environment.yml"
    threads: job["assess"].threads
    resources:
        **job["assess"].resources,
    params:
        **job["assess"].params,
    message:
        "{wildcards.flight}: comparing the images"
    shell:
        "apertura step assess {wildcards.flight} > {log} 2>&1"
