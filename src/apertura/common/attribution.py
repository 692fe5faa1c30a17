"""Attribution of products: title, creators, institution, licence, platform, instrument and DOI, as configured."""

import re
from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from apertura.common.errors import quoted

_LONGEST_TITLE = 120


def _title(text: str) -> str:
    invalid = next((char for char in text if not char.isprintable() or char in '"<>&\\'), None)
    if invalid is not None:
        raise ValueError(
            f"{quoted(text)}: {quoted(invalid)} may not be used, because the text is written to WKT, HTML and file tags"
        )
    if not 1 <= len(text.strip()) <= _LONGEST_TITLE:
        raise ValueError(f"{len(text.strip())} characters: 1 to {_LONGEST_TITLE} may be used")
    return text


def _orcid(identifier: str) -> str:
    """Check an ORCID iD, including its check character; return it without https://orcid.org/."""
    digits = identifier.removeprefix("https://orcid.org/")
    if not re.fullmatch(r"([0-9]{4}-){3}[0-9]{3}[0-9X]", digits):
        raise ValueError(f"{quoted(identifier)}: must be an ORCID iD such as 0000-0002-1825-0097")
    # ISO 7064 MOD 11-2: s ← 2·(s + digit) over the first 15 digits; the check character is (12 - s mod 11) mod 11.
    total = 0
    for digit in digits.replace("-", "")[:-1]:
        total = 2 * (total + int(digit))
    expected = "0123456789X"[(12 - total % 11) % 11]
    if digits[-1] != expected:
        raise ValueError(f"{quoted(identifier)}: the check character must be {expected}: correct the ORCID iD")
    return digits


Title = Annotated[str, AfterValidator(_title)]
"""One line of text without characters that WKT, HTML or a terminal interpret."""

Licence = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9.+-]{0,63}$")]
"""SPDX identifier."""

Doi = Annotated[str, Field(pattern=r"^10\.[0-9]{4,9}/[A-Za-z0-9._;()/:-]{1,100}$")]
"""Digital object identifier, without https://doi.org/."""

Orcid = Annotated[str, AfterValidator(_orcid)]
"""ORCID iD of a person, without https://orcid.org/."""


class _Stated(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Creator(_Stated):
    """Person to be credited.

    Examples
    --------
    >>> str(Creator(name="A. Nother", orcid="https://orcid.org/0000-0002-1825-0097", affiliation="An Institute"))
    'A. Nother (ORCID 0000-0002-1825-0097, An Institute)'
    """

    name: Title = Field(description="name of the person")
    orcid: Orcid | None = Field(None, description="ORCID iD, such as 0000-0002-1825-0097; null: none")
    affiliation: Title | None = Field(None, description="institution of the person; null: not stated")

    def __str__(self) -> str:
        details = [f"ORCID {self.orcid}"] if self.orcid else []
        details += [self.affiliation] if self.affiliation else []
        return f"{self.name} ({', '.join(details)})" if details else self.name


class Attribution(_Stated):
    """Metadata that recordings and logs do not contain; products have no field for a value that is not stated."""

    title: Title | None = Field(None, description="title of the data set; null: the name of the campaign")
    creators: tuple[Creator, ...] = Field(
        (),
        description="persons to be credited, in the order of the citation: list of name, and if known orcid and "
        "affiliation",
    )
    institution: Title | None = Field(
        None, description="institution that makes and publishes the products; null: not stated"
    )
    licence: Licence | None = Field(
        None, description="licence of the products, an SPDX identifier such as CC-BY-4.0; null: not stated"
    )
    platform: Title | None = Field(None, description="aircraft, such as a type or a registration; null: not stated")
    instrument: Title | None = Field(None, description="radar, such as its type; null: not stated")
    doi: Doi | None = Field(None, description="DOI of the data set, such as 10.5281/zenodo.1234567; null: none")

    def citation(self, campaign: str, year: int | None = None) -> str | None:
        """Return the citation of the data set in the style of DataCite; None without a creator or an institution.

        Parameters
        ----------
        campaign
            Name of the campaign, which is the title unless a title is stated.
        year
            Year of the acquisition; None: not known.

        Examples
        --------
        >>> stated = Attribution(creators=[{"name": "A. Nother"}, {"name": "B. Other"}], doi="10.5281/zenodo.1")
        >>> stated.citation("Harbour", 2025)
        'A. Nother; B. Other (2025): Harbour. https://doi.org/10.5281/zenodo.1'
        """
        names = [creator.name for creator in self.creators] or ([self.institution] if self.institution else [])
        if not names:
            return None
        heading = "; ".join(names) + (f" ({year})" if year else "")
        publisher = [self.institution] if self.institution and self.creators else []
        reference = f" https://doi.org/{self.doi}" if self.doi else ""
        return f"{heading}: {'. '.join([self.title or campaign, *publisher])}.{reference}"
