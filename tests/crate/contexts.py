"""Fill the HTTP cache of roc-validator with JSON-LD contexts, so that it runs offline.

    python contexts.py CACHE RO_CRATE_CONTEXT

Runs in the environment of the validator. The context of RO-Crate is part of the package `rocrate`; the terms of
workflow runs are names below one address and are assembled in this module.
"""

import io
import json
import sys
from pathlib import Path

import requests
import requests_cache
from urllib3 import HTTPResponse

RUN = "https://w3id.org/ro/terms/workflow-run"
RUN_TERMS = (
    "ParameterConnection", "sourceParameter", "targetParameter", "sourceOrganization", "connection", "environment",
    "resourceUsage", "containerImage", "ContainerImage", "DockerImage", "SIFImage", "registry", "tag",
    "md5", "sha1", "sha256", "sha512",
)  # fmt: skip
BIOSCHEMAS = "https://bioschemas.org/"
WORKFLOW_TERMS = {
    "ComputationalWorkflow": f"{BIOSCHEMAS}ComputationalWorkflow",
    "FormalParameter": f"{BIOSCHEMAS}FormalParameter",
    "input": f"{BIOSCHEMAS}ComputationalWorkflow#input",
    "output": f"{BIOSCHEMAS}ComputationalWorkflow#output",
}
ACCEPTED = (
    "application/ld+json, application/json, */*;q=0.1",
    "application/ld+json, application/json",
    "application/ld+json",
)


class DocumentAdapter(requests.adapters.BaseAdapter):
    """HTTP adapter that answers with given documents, without network access."""

    def __init__(self, documents):
        super().__init__()
        self.documents = documents

    def send(self, request, **_):
        body = b"" if request.method == "HEAD" else json.dumps(self.documents[request.url]).encode()
        answer = HTTPResponse(
            io.BytesIO(body),
            {"Content-Type": "application/ld+json"},
            200,
            preload_content=False,
            request_url=request.url,
        )
        return requests.adapters.HTTPAdapter().build_response(request, answer)

    def close(self):
        pass


def main(cache, context):
    crate_context = json.loads(Path(context).read_text(encoding="utf-8"))
    documents = {
        "https://w3id.org/ro/crate/1.1/context": {
            **crate_context,
            "@context": {**crate_context["@context"], **WORKFLOW_TERMS},
        },
        f"{RUN}/context": {"@context": {term: f"{RUN}#{term}" for term in RUN_TERMS}},
    }
    session = requests_cache.CachedSession(
        cache, backend="sqlite", expire_after=-1, allowable_codes=[200], allowable_methods=["GET", "HEAD"]
    )
    session.mount("https://", DocumentAdapter(documents))
    for address in documents:
        session.head(address)
        for accepted in ACCEPTED:
            session.get(address, headers={"Accept": accepted})


if __name__ == "__main__":
    main(*sys.argv[1:])
