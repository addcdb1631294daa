"""Misprints of the paper's tables and text, and the values used instead."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from .results import Erratum


def guestrin(misprints: Mapping[str, Mapping[str, Any]]) -> list[Erratum]:
    """Return the errata for the replication of Guestrin & Eizenman (2006).

    `misprints` holds the effects: eye model -> case -> H1, H2, counts.
    """
    return [
        Erratum(
            where="Table 4, camera",
            printed="(315, IPD/2, -150.5) mm, tilted by 13.8 deg",
            used="x = 615 mm: atan(150.5 / 615) = 13.75 deg, while 315 mm would need 25.5 deg",
            effect=_effect(misprints, "camera at x = 315"),
        ),
        Erratum(
            where="section 2.1, head positions",
            printed="30 cm to each side and 40 cm forward and back",
            used="30 mm and 40 mm: 40 cm forward leaves 21 cm to the camera, and the eye leaves its 640 px",
            effect=_effect(misprints, "head positions in cm"),
        ),
        Erratum(
            where="section 2.1, calibration",
            printed="four parameters are listed, then 'the five parameters' are calibrated",
            used="R, K, alpha, beta; the index fixed, and free as a variant",
            effect="see the variants 'index fixed' and 'index free'",
        ),
        Erratum(
            where="Table 3, E5, anterior lens radius",
            printed="4.304 mm",
            used="14.304 mm (with 4.3 mm the lens would be a ball)",
            effect="none on pupil and glints: the lens lies behind the stop and only places the fovea",
        ),
        Erratum(
            where="section 3.2, E5",
            printed="errors above 11 deg, put down to decentration and tilt of its surfaces",
            used="Table 3's E5; the variants E5-published and E5-published-stop use the pupil's tilt (0.91, -1.64) as "
            "its translation in mm, as the authors' software does",
            effect="finding P2",
        ),
        Erratum(
            where="Figure 4, caption", printed="real-world errors reported by [29]", used="those of [28]", effect="none"
        ),
    ]


def blignaut() -> list[Erratum]:
    """Return the errata for the replication of Blignaut (2014)."""
    return [
        Erratum(
            where="Table 5, best functions",
            printed="R5 for C9",
            used="R5 for the paper's own sentence (B1); the experiment's figures have R7 (.80 deg), then R4 (.87 deg), "
            "and 1.09 deg for R5",
            effect="B1 for C9 is false in either way",
        ),
        Erratum(
            where="section 3.1",
            printed="'the four-surface eye model (E2)'",
            used="E3 is the four-surface model",
            effect="none",
        ),
        Erratum(
            where="section 3.3",
            printed="'10% to 20% of the experimentally observed errors'",
            used="each set's share is printed (B5)",
            effect="false for some sets",
        ),
        Erratum(
            where="Table 2",
            printed="terms of x and y without saying about which origin",
            used="the pupil-glint vector itself; a polynomial about the calibration vectors' mean is a variant",
            effect="most of R4 and R6 to R12 are other functions then: compare 'vector' and 'centred vector'",
        ),
    ]


def _effect(misprints: Mapping[str, Mapping[str, Any]], case: str) -> str:
    parts = []
    for model, cases in misprints.items():
        found = cases.get(case)
        if found is None:
            continue
        h1, h2 = (found[h] for h in ("H1", "H2"))
        if h1 is None or h2 is None:
            parts.append(f"{model}: {found.get('reason') or 'no estimate'}")
        else:
            parts.append(f"{model} {h1:.3f}/{h2:.3f} deg ({found['in_image']} of {found['n']} in the image)")
    return "; ".join(parts) or "not run"
