"""Results of every comparison become tables that fit a terminal and name the stand-in, and readable pictures."""

from __future__ import annotations

import io
import itertools
import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.transforms import Bbox
from PIL import Image
from rich.console import Console

from pebble.bench import bridge, control, cost, frames, plots, scale, startup, traffic
from pebble.bench.impair import trials
from pebble.bench.results import STAND_IN, Cell, Results, load
from pebble.bench.show import Shown, digits, finish, spread
from pebble.errors import PebbleError
from tests.bench import synthetic
from tests.support import some

pytestmark = pytest.mark.filterwarnings("error::UserWarning")  # matplotlib warns if a layout does not fit
LARGEST = 200_000  # bytes of a file
TOUCH = 1.0  # pixels


def of_scale() -> Results:
    cells = [
        synthetic.cell(variant, measure, unit, boards / 10, rounds=1, figures={"sent": 60}, boards=boards, **process)
        for boards in (10, 100, 1000)
        for variant in scale.VARIANTS
        for measure, unit, process in (
            (scale.CPU, "%", {"process": variant}), (scale.MEMORY, "MB", {}), (scale.LATENCY, "ms", {}),
        )
    ]  # fmt: skip
    return Results(bench="scale", cells=cells)


def of_traffic() -> Shown:
    robots = synthetic.analysed()
    results = Results(bench="traffic", cells=list(traffic.cells_of(robots)))
    return Shown(results, [traffic.media_table(robots), traffic.heartbeat_table(robots)], traffic.figures(robots))


SHOWN = {
    "control": lambda: control.shown(synthetic.of_control()),
    "bridge": lambda: bridge.shown(synthetic.of_bridge()),
    "startup": lambda: startup.shown(synthetic.of_startup()),
    "cost": lambda: cost.shown(synthetic.of_cost()),
    "frames": lambda: frames.shown(synthetic.of_frames()),
    "scale": lambda: scale.shown(of_scale()),
    "traffic": of_traffic,
    "impair": lambda: trials.shown(synthetic.of_impair(), 8.0),
}


@pytest.mark.parametrize("name", SHOWN)
def test_tables_are_whole_in_120_columns(name: str) -> None:
    console = Console(file=io.StringIO(), width=120, record=True)
    for table in SHOWN[name]().tables:
        assert console.measure(table).maximum <= 120
        console.print(table)
    assert "…" not in console.export_text()


@pytest.mark.parametrize("name", ["control", "bridge", "impair"])
def test_the_stand_in_is_named_so_in_every_table(name: str) -> None:
    for table in SHOWN[name]().tables:
        console = Console(file=io.StringIO(), width=120, record=True)
        console.print(table)
        assert STAND_IN in console.export_text()


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


@pytest.mark.parametrize("name", some([name for name in SHOWN if name not in ("startup", "cost")], 4))
def test_pictures_can_be_read(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[Figure] = []
    savefig = Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda figure, *a, **k: (made.append(figure), savefig(figure, *a, **k)))
    pictures = SHOWN[name]().pictures
    files = [plots.save(picture, tmp_path, quick=False) for picture in pictures]
    assert files
    for file, figure in zip(files, made, strict=True):
        assert file.name.startswith(name)
        assert file.stat().st_size < LARGEST
        assert Image.open(file).format == "PNG"
        assert unreadable(figure) == []


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


def test_nothing_measured_is_no_picture() -> None:
    nothing = [Cell(variant="mqtt", measure="way", unit="us", params={"n": 1}, rounds=rounds) for rounds in ([], [[]])]
    assert (plots.curves("x", "X", nothing), plots.lines("x", "X", nothing, over="n")) == ([], [])


def test_a_distribution_ends_below_100_percent_by_what_was_lost() -> None:
    for sent, top in ((90, 100), (100, 90)):
        cell = Cell(variant="mqtt", measure="way", unit="ms", rounds=[[1.0] * 90], figures={"sent": [sent]})
        (picture,) = plots.curves("x", "X", [cell])
        (curve, *_) = picture.make().axes[0].get_lines()
        assert max(curve.get_ydata()) == pytest.approx(top)  # type: ignore[arg-type]


def test_a_percentile_of_commands_counts_those_that_never_arrived() -> None:
    def drawn(sent: int) -> float:
        results = synthetic.of_impair()
        for cell in results.cells:
            cell.rounds, cell.figures["sent"] = [[5.0] * 90], [sent]
        picture = next(one for one in trials.shown(results, 8.0).pictures if one.name == "impair-drive")
        return float(picture.make().axes[0].get_lines()[0].get_ydata()[0])  # type: ignore[index,arg-type]

    assert drawn(94) == 5.0
    assert math.isnan(drawn(99))


def test_only_figures_of_robots_that_were_analysed_are_drawn() -> None:
    robots = synthetic.analysed()
    for known, numbers in ((robots, range(1, 7)), ({"goob": robots["goob"]}, range(1, 3))):
        (picture,) = traffic.figures(known)
        titles = [axes.get_title(loc="left").split(":")[0] for axes in picture.make().axes]
        assert titles == [f"Figure 4.{number}" for number in numbers]


@pytest.mark.parametrize(
    "variants", [tuple(control.VARIANTS), frames.VARIANTS, bridge.FULL.variants, scale.VARIANTS, trials.SUBJECTS]
)
def test_each_variant_of_a_comparison_has_a_style_like_no_other(variants: Sequence[str]) -> None:
    assert len(set(plots.styles(variants).values())) == len(variants)


def test_numbers_have_three_digits() -> None:
    assert [digits(value) for value in (1234.5, 99.96, 12.345, 0.1234, math.nan, math.inf)] == [
        "1234", "100", "12.3", "0.12", "–", "never",
    ]  # fmt: skip
    cell = Cell(variant="a", measure="m", unit="s", rounds=[[3.0], [1.0], [], [2.0]])
    assert (spread(cell), spread(None)) == ("2.00 (1.00 to 3.00)", "–")


# -- the end of a run


@pytest.mark.parametrize("complete", [True, False])
def test_everything_is_printed_and_written(complete: bool, tmp_path: Path) -> None:
    printed, shown = io.StringIO(), SHOWN["scale"]()
    shown.results.complete, shown.results.notes, shown.results.quick = complete, ["[h264] is left out"], True
    assert finish(shown, tmp_path, Console(file=printed, width=120)) == int(not complete)
    assert "boards" in printed.getvalue()
    assert "[h264] is left out" in printed.getvalue()
    assert load(tmp_path / "scale.json").quick
    image = Image.open(tmp_path / "scale.png").convert("L")
    assert image.crop((image.width - 120, 0, image.width, 30)).getextrema() != (255, 255), "it is marked as quick"


def test_a_file_that_cannot_be_written_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(PebbleError, match="No such file or directory"):
        finish(SHOWN["startup"](), tmp_path / "nowhere", Console(file=io.StringIO()))


def test_without_matplotlib_there_are_no_plots(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pebble.bench.show.find_spec", lambda _name: None)
    printed = io.StringIO()
    finish(SHOWN["scale"](), tmp_path, Console(file=printed, width=120))
    assert "No plots: pip install 'pebble-robot[bench]'" in printed.getvalue()
    assert [path.name for path in tmp_path.iterdir()] == ["scale.json"]
