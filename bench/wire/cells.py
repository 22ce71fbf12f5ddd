"""A cell of bytes on the wire, beside those of a reference.

Nothing is sent. Bytes are the same in every run with the same programs, so there is one sample per cell.
"""

from __future__ import annotations

from pebble.bench.comparison import Case
from pebble.bench.results import Cell, Value

Coded = dict[str, float]  # figures of a clip or of speech in one encoding; "wire": per second


def wire_cell(case: Case, unit: str, coded: Coded, reference: Coded, params: dict[str, Value] | None = None) -> Cell:
    found = {**coded, "ratio": coded["wire"] / reference["wire"]}
    if "ssim" in coded:
        found["ssim_off"] = coded["ssim"] - reference["ssim"]
    figures = {name: round(value, 4) for name, value in found.items() if name != "wire"}
    return case.cell("wire", unit, [coded["wire"]], params, **figures)
