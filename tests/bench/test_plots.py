"""Results of every shape become readable pictures."""

import io
import itertools
import math
from collections.abc import Iterator
from pathlib import Path

import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.transforms import Bbox
from PIL import Image

from pebble.bench.impair.pictures import marks
from pebble.bench.pictures import draw, pictures
from pebble.bench.plots import save, styles
from pebble.bench.results import Cell, Results
from pebble.errors import PebbleError
from tests.bench import synthetic
from tests.support import some

pytestmark = pytest.mark.filterwarnings("error::UserWarning")  # matplotlib warns if a layout does not fit
SHAPES = [*synthetic.one_of_each(small=True).values(), synthetic.broken()]
LARGEST = 200_000  # bytes of a file
TOUCH = 1.0  # pixels


def texts(figure: Figure) -> Iterator[tuple[str, Bbox]]:
    """The visible texts of a drawn figure, with their boxes; ticks beyond the ends of an axis are invisible."""
    figure.set_layout_engine("none")  # the layout is already computed
    renderer = FigureCanvasAgg(figure).get_renderer()
    unseen = set()
    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            low, high = sorted(axis.get_view_interval())
            slack = 1e-6 * (high - low)
            for tick in (*axis.get_major_ticks(), *axis.get_minor_ticks()):
                if not low - slack <= tick.get_loc() <= high + slack:
                    unseen |= {tick.label1, tick.label2}
    for text in figure.findobj(Text):
        assert isinstance(text, Text)
        if text.get_visible() and text.get_text().strip() and text not in unseen and text.get_rotation() in (0, 90):
            yield text.get_text(), text.get_window_extent(renderer)


def unreadable(figure: Figure) -> list[tuple[str, ...]]:
    """Pairs of overlapping texts, and texts that exceed the edge."""
    box, places = figure.bbox, list(texts(figure))
    assert places
    return [
        *((one, other) for (one, a), (other, b) in itertools.combinations(places, 2) if _overlap(a, b)),
        *(
            (text,)
            for text, a in places
            if a.x0 < -TOUCH or a.y0 < -TOUCH or a.x1 > box.x1 + TOUCH or a.y1 > box.y1 + TOUCH
        ),
    ]


def _overlap(a: Bbox, b: Bbox) -> bool:
    return min(a.x1, b.x1) - max(a.x0, b.x0) > TOUCH and min(a.y1, b.y1) - max(a.y0, b.y0) > TOUCH


@pytest.mark.parametrize("results", some(reversed(SHAPES), 8), ids=lambda results: results.bench)
def test_pictures_of_every_comparison_can_be_read(
    results: Results, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[Figure] = []
    savefig = Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda figure, *a, **k: (made.append(figure), savefig(figure, *a, **k)))
    files = list(draw(results, tmp_path))
    assert files
    assert [file.stem for file in files] == [picture.name for picture in pictures(results)]
    for file, figure in zip(files, made, strict=True):
        assert file.name.startswith(results.bench)
        assert file.stat().st_size < LARGEST
        assert Image.open(file).format == "PNG"
        assert unreadable(figure) == []
        assert all(axes.get_xlabel() or axes.get_ylabel() for axes in figure.axes)


def test_texts_that_lie_over_each_other_would_be_seen() -> None:
    figure = Figure(layout="constrained")
    axes = figure.add_subplot()
    axes.text(0.5, 0.5, "one")
    axes.text(0.51, 0.5, "other")
    axes.text(1.2, 0.2, "outside")
    figure.savefig(io.BytesIO())
    figure.set_size_inches(5, 4)
    assert ("one", "other") in unreadable(figure)
    assert ("outside",) in unreadable(figure)


@pytest.mark.parametrize("bench", synthetic.one_of_each(small=True))
def test_nothing_measured_is_no_picture(bench: str, tmp_path: Path) -> None:
    nothing = [Cell(variant="mqtt", measure="one-way", unit="us", rounds=rounds) for rounds in ([], [[]], [[math.nan]])]
    assert not draw(Results(bench=bench, cells=nothing), tmp_path)
    assert not draw(Results(bench=bench), tmp_path)


@pytest.mark.thorough
def test_the_trials_that_were_run_are_enough(tmp_path: Path) -> None:
    one = synthetic.impair(("5%",))
    one.cells = [cell for cell in one.cells if cell.variant == "zenoh h264 opus" and cell.measure != "audio latency"]
    assert len(draw(one, tmp_path)) == 6


@pytest.mark.thorough
def test_a_quick_run_is_marked_in_the_picture(tmp_path: Path) -> None:
    (picture,) = pictures(synthetic.startup())
    for quick in (False, True):
        save(picture, tmp_path / f"{quick}.png", Results(bench="startup", quick=quick))
    quick_one, full_one = (Image.open(tmp_path / f"{quick}.png").convert("L") for quick in (True, False))
    corner = (quick_one.width - 120, 0, quick_one.width, 30)
    assert quick_one.crop(corner).getextrema() != (255, 255)
    assert full_one.crop(corner).getextrema() == (255, 255)


def test_a_distribution_ends_below_100_percent_by_what_was_lost() -> None:
    whole = Cell(variant="mqtt", measure="way", unit="ms", rounds=[[1.0] * 90])
    lossy = Cell(variant="mqtt", measure="way", unit="ms", rounds=[[1.0] * 90], figures={"sent": 100})
    (all_of_it,), (most_of_it,) = (pictures(Results(bench="estop", cells=[cell])) for cell in (whole, lossy))
    assert "lost ones included" in most_of_it.caption
    for picture, top in ((all_of_it, 100), (most_of_it, 90)):
        (curve, *_) = picture.make().axes[0].get_lines()
        assert max(curve.get_ydata()) == pytest.approx(top)  # type: ignore[arg-type]


def test_a_percentile_of_commands_counts_those_that_never_arrived() -> None:
    def drawn(sent: int) -> list[float]:
        cell = Cell(variant="mqtt original", params={"trial": "64k"}, measure="drive alone", unit="ms",
                    rounds=[[5.0] * 90], figures={"sent": sent})  # fmt: skip
        (picture,) = (one for one in pictures(Results(bench="impair", cells=[cell])) if one.name == "impair-drive")
        return list(picture.make().axes[0].get_lines()[0].get_ydata())  # type: ignore[arg-type]

    assert drawn(94) == [5.0]
    assert math.isnan(drawn(99)[0])


@pytest.mark.parametrize(("rounds", "lines"), [(7, False), (8, True)])
def test_few_rounds_have_no_interval(rounds: int, lines: bool) -> None:
    cells = [Cell(variant=name, measure="up", unit="ms", rounds=synthetic.latencies(1.0, 30, rounds))
             for name in ("mqtt", "zenoh")]  # fmt: skip
    (picture,) = (one for one in pictures(Results(bench="bridge", cells=cells)) if one.name == "bridge-ratios")
    assert ("intervals of 99 %" in picture.caption) == lines
    (interval, *_) = picture.make().axes[0].get_lines()
    low, high = interval.get_xdata()  # type: ignore[misc]
    assert (low < high) == lines


def test_a_role_of_a_null_test_has_one_colour_in_all_pictures() -> None:
    ratios, curves = (one.make() for one in pictures(synthetic.null_test("bridge", "zenoh")))

    def colours(figure: Figure) -> dict[str, object]:
        (legend,) = figure.legends
        texts = [text.get_text() for text in legend.get_texts()]
        return dict(zip(texts, [line.get_color() for line in legend.get_lines()], strict=True))

    assert colours(ratios).items() <= colours(curves).items()


def test_a_file_that_cannot_be_written_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(PebbleError, match="No such file or directory"):
        draw(synthetic.startup(), tmp_path / "nowhere")


def test_a_variant_looks_the_same_everywhere_and_like_no_other() -> None:
    alone, together = styles(["zenoh-p2p"]), styles(["mqtt", "paho", "zenoh-hub", "zenoh-p2p"])
    assert together["zenoh-p2p"] == alone["zenoh-p2p"]
    unknown = styles(["mqtt", "mqtt again", "mqtt +20 %", "zenoh", "zenoh-new", "other", "another"])
    assert len({style.colour for style in unknown.values()}) == len(unknown)


def test_marks_are_names_and_seconds() -> None:
    assert marks("base-start@1;256k+1%@20;64k@30.5") == [("base-start", 1.0), ("256k+1%", 20.0), ("64k", 30.5)]
    assert marks("") == []
