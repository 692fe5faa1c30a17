rule echo:
    input:
        lambda wildcards: result_of(campaign, "echo", wildcards.flight, wildcards.pair).sources,
    output:
        "results/{flight}/{pair}/echo.manifest.json",
    log:
        "results/logs/{flight}/{pair}.echo.log",
    benchmark:
        "results/benchmarks/{flight}/{pair}.echo.tsv"
    conda:
        "../../environment.yml"
    threads: asked["echo"].threads
    resources:
        mem_mb=asked["echo"].mem_mb,
        runtime=asked["echo"].runtime,
    params:
        settings=lambda wildcards: campaign.relevant("echo", wildcards.pair, flight=wildcards.flight),
        code=lambda wildcards: result_of(campaign, "echo", wildcards.flight, wildcards.pair).code_sha256,
    message:
        "{wildcards.flight}: calibrating {wildcards.pair}"
    shell:
        "apertura step echo {wildcards.flight} {wildcards.pair} > {log} 2>&1"


rule calibrate:
    input:
        lambda wildcards: result_of(campaign, "calibration", wildcards.flight).sources,
    output:
        "results/{flight}/calibration.json",
        "results/{flight}/calibration.manifest.json",
    log:
        "results/logs/{flight}/calibrate.log",
    benchmark:
        "results/benchmarks/{flight}/calibrate.tsv"
    conda:
        "../../environment.yml"
    threads: asked["calibrate"].threads
    resources:
        mem_mb=asked["calibrate"].mem_mb,
        runtime=asked["calibrate"].runtime,
    params:
        settings=lambda _: campaign.relevant("calibration"),
        code=lambda wildcards: result_of(campaign, "calibration", wildcards.flight).code_sha256,
    message:
        "{wildcards.flight}: estimating path offsets from the reflector"
    shell:
        "apertura step calibrate {wildcards.flight} > {log} 2>&1"


rule profile:
    input:
        lambda wildcards: result_of(campaign, "profile", wildcards.flight, wildcards.pair).sources,
    output:
        "results/{flight}/{pair}/profile.manifest.json",
    log:
        "results/logs/{flight}/{pair}.profile.log",
    benchmark:
        "results/benchmarks/{flight}/{pair}.profile.tsv"
    conda:
        "../../environment.yml"
    threads: asked["profile"].threads
    resources:
        mem_mb=asked["profile"].mem_mb,
        runtime=asked["profile"].runtime,
    params:
        settings=lambda wildcards: campaign.relevant("profile", wildcards.pair),
        code=lambda wildcards: result_of(campaign, "profile", wildcards.flight, wildcards.pair).code_sha256,
    message:
        "{wildcards.flight}: compressing {wildcards.pair} in range"
    shell:
        "apertura step profile {wildcards.flight} {wildcards.pair} > {log} 2>&1"
