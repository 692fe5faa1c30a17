rule echo:
    input:
        raw=each("results/{flight}/{node}/raw.manifest.json"),
        track=each("results/{flight}/{node}/track.manifest.json"),
        recordings=files(inputs.transmitted_and_received),
        heights=files(inputs.ground_under_air),
    output:
        "results/{flight}/{pair}/echo.manifest.json",
    log:
        "results/logs/{flight}/{pair}.echo.log",
    benchmark:
        "results/benchmarks/{flight}/{pair}.echo.tsv"
    conda:
        "../../environment.yml"
    threads: job["echo"].threads
    resources:
        **job["echo"].resources,
    params:
        **job["echo"].params,
    message:
        "{wildcards.flight}: forming the echo of {wildcards.pair}"
    shell:
        "apertura step echo {wildcards.flight} {wildcards.pair} > {log} 2>&1"


rule transfer:
    input:
        echo="results/{flight}/{pair}/echo.manifest.json",
        recordings=files(inputs.received),
    output:
        "results/{flight}/{pair}/transfer.manifest.json",
    log:
        "results/logs/{flight}/{pair}.transfer.log",
    benchmark:
        "results/benchmarks/{flight}/{pair}.transfer.tsv"
    conda:
        "../../environment.yml"
    threads: job["transfer"].threads
    resources:
        **job["transfer"].resources,
    params:
        **job["transfer"].params,
    message:
        "{wildcards.flight}: storing the transfer functions of {wildcards.pair}"
    shell:
        "apertura step transfer {wildcards.flight} {wildcards.pair} > {log} 2>&1"


rule calibrate:
    input:
        echo=each("results/{flight}/{pair}/echo.manifest.json"),
    output:
        "results/{flight}/calibration.json",
        "results/{flight}/calibration.manifest.json",
    log:
        "results/logs/{flight}/calibrate.log",
    benchmark:
        "results/benchmarks/{flight}/calibrate.tsv"
    conda:
        "../../environment.yml"
    threads: job["calibrate"].threads
    resources:
        **job["calibrate"].resources,
    params:
        **job["calibrate"].params,
    message:
        "{wildcards.flight}: estimating path offsets from the reflector"
    shell:
        "apertura step calibrate {wildcards.flight} > {log} 2>&1"


rule profile:
    input:
        echo="results/{flight}/{pair}/echo.manifest.json",
        scene="results/scene.manifest.json",
        terrain=each("results/terrain.manifest.json"),
        patterns=files(inputs.patterns),
    output:
        "results/{flight}/{pair}/profile.manifest.json",
    log:
        "results/logs/{flight}/{pair}.profile.log",
    benchmark:
        "results/benchmarks/{flight}/{pair}.profile.tsv"
    conda:
        "../../environment.yml"
    threads: job["profile"].threads
    resources:
        **job["profile"].resources,
    params:
        **job["profile"].params,
    message:
        "{wildcards.flight}: compressing {wildcards.pair} in range"
    shell:
        "apertura step profile {wildcards.flight} {wildcards.pair} > {log} 2>&1"
