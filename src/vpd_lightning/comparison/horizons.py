"""Scores by predicted step: every system beside what needs no learning, and how far bodies are from that."""

from collections.abc import Iterator, Sequence

from vpd_lightning.comparison.bootstrap import MetricSamples, difference, estimate
from vpd_lightning.comparison.comparison_table import ComparisonTable, Row
from vpd_lightning.comparison.tables import TITLES, difference_text, estimate_text, markdown
from vpd_lightning.metrics.metric_info import MetricInfo
from vpd_lightning.metrics.registry import REFERENCES, referenced, references_of, scores

STEPS = (1, 4, 8, 16, 32)


def shown_steps(num_steps: int) -> list[int]:
    """The steps that stand in the tables (from 1): those of ``STEPS`` that were predicted, and the last."""
    return [*(step for step in STEPS if step < num_steps), num_steps]


def horizon_tables(table: ComparisonTable) -> list[str]:
    """One table per score and per motion error with references; systems in rows, predicted steps in columns.

    Brackets hold the 95 % interval of that step. Under a motion error, "less" rows are paired differences to what
    needs no learning, on the same trajectories.
    """
    lines: list[str] = []
    for info in (*scores(), *referenced()):
        measured = list(_measured(table, info))
        if not measured:
            continue
        num_bootstrap = table.runs[0].num_bootstrap
        steps = shown_steps(max(samples.total.shape[2] for _, samples in measured))
        rows = [[row.system, *_cells(info, samples, steps, num_bootstrap)] for row, samples in measured]
        for title, reference in _references(table, info):
            if info in referenced():
                rows += [
                    [f"{row.system} less {title}", *_differences(info, samples, reference, steps, num_bootstrap)]
                    for row, samples in measured
                ]
            rows.append([f"*{title}*", *_cells(info, reference, steps, num_bootstrap)])
        lines += [*markdown([f"{info.label} after", *map(str, steps)], rows), ""]
    return lines


def _measured(table: ComparisonTable, info: MetricInfo) -> Iterator[tuple[Row, MetricSamples]]:
    for row in table.main_rows:
        samples = row.samples(info.name)
        if samples is not None:
            yield row, samples


def _references(table: ComparisonTable, info: MetricInfo) -> Iterator[tuple[str, MetricSamples]]:
    places = [(TITLES[source], source, info.name) for source in REFERENCES]
    places += [(other.title, "model", other.name) for other in references_of(info)]
    for title, source, name in places:
        samples = table.reference_samples(source, name)
        if samples is not None:
            yield title, samples


def _cells(info: MetricInfo, samples: MetricSamples, steps: Sequence[int], num_bootstrap: int) -> list[str]:
    parts = [_step(samples, step) for step in steps if step <= samples.total.shape[2]]
    cells = [estimate_text(info, estimate(part, num_bootstrap)) for part in parts]
    return [*cells, *["-"] * (len(steps) - len(cells))]


def _differences(
    info: MetricInfo, own: MetricSamples, reference: MetricSamples, steps: Sequence[int], num_bootstrap: int
) -> list[str]:
    if reference.total.shape[1:] != own.total.shape[1:]:
        return ["-"] * len(steps)
    found = [difference(_step(own, step), _step(reference, step), num_bootstrap) for step in steps]
    return ["-" if one is None else difference_text(info, one[0]) for one in found]


def _step(samples: MetricSamples, step: int) -> MetricSamples:
    return MetricSamples(samples.total[..., step - 1 : step], samples.count[..., step - 1 : step])
