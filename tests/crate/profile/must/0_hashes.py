"""Requirement for roc-validator: every file of the crate has a sha256 that agrees with its bytes."""

import hashlib
from pathlib import Path
from urllib.parse import unquote, urlsplit

from rocrate_validator.models import ValidationContext
from rocrate_validator.requirements.python import PyFunctionCheck, check, requirement


@requirement(name="Hashes of files")
class Hashes(PyFunctionCheck):
    """Every file of the crate MUST have a sha256 that agrees with its bytes."""

    @check(name="Hashes of files")
    def check_hashes(self, context: ValidationContext) -> bool:
        """Compare every file with its hash."""
        root, good = Path(unquote(urlsplit(str(context.ro_crate.uri)).path)), True
        for entity in context.ro_crate.metadata.get_file_entities():
            stated = entity.get_property("sha256")
            path = root / unquote(entity.id)
            if stated is None:
                context.result.add_issue(f"{entity.id}: no sha256 is stated", self)
            elif not path.is_file():
                context.result.add_issue(f"{entity.id}: no such file", self)
            elif hashlib.sha256(path.read_bytes()).hexdigest() != stated:
                context.result.add_issue(f"{entity.id}: sha256 differs from that of the bytes", self)
            else:
                continue
            good = False
        return good
