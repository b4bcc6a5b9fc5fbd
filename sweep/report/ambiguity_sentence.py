"""What a threshold on the ambiguity does, as a sentence of the answer."""

from __future__ import annotations

from sweep.analysis.ambiguities import ThresholdChoice
from sweep.report.ambiguity_figure import AMBIGUITY, USUAL, by_configurations
from sweep.report.configurations import configurations
from sweep.report.formatting import number
from sweep.report.grouping import CONFIGURATION, Grouping
from sweep.report.report_data import ReportData

CHOICES = {
    ThresholdChoice.not_needed: "no threshold is needed for {wanted} %",
    ThresholdChoice.none: "no threshold brings them to {wanted} %",
    ThresholdChoice.too_few_draws: "there are too few draws to tell whether a threshold brings "
                                   "them to {wanted} %",
}
"""What is said of choices without a threshold."""


def threshold_sentence(data: ReportData, best: int) -> str:
    """Return how many poses are flips, and what thresholds keep, of one configuration.

    Empty where there are no flips, or more configurations than the report tells apart.
    """
    if not AMBIGUITY.applies(data):
        return ""
    names, table = by_configurations(data, Grouping())
    if len(names) != len(configurations(data).names):
        return ""
    one = table.isel({CONFIGURATION: best})
    if not int(one["flipped"]):
        return ""
    usual = one.sel(threshold=USUAL)
    wanted = f"{100 * float(table.attrs['flip_rate']):g}"
    choice = ThresholdChoice(int(one["choice"]))
    flips = 100 * float(one["flipped"]) / float(one["solved"])
    begin = f"Flips to the mirrored pose are {number(flips)} % of the solved"
    if int(one["without_alternative"]) == int(one["solved"]):
        return f"{begin}; this solver returns one solution, so that no threshold tells them."
    text = (
        f"{begin}; the usual threshold of {USUAL:g} on the ambiguity rejects "
        f"{number(100 - 100 * float(usual['kept_rate']))} % of "
        f"the poses, {number(100 * float(usual['rejected_right_rate']))} % of them right, and "
        f"keeps {number(100 * float(usual['kept_flip_rate']))} % flips")
    if choice == ThresholdChoice.found:
        text += (f"; {number(float(one['chosen_threshold']))} brings them to {wanted} % and keeps "
                 f"{number(100 * float(one['chosen_kept_rate']))} % of the poses")
    elif choice in CHOICES:
        text += f"; {CHOICES[choice].format(wanted=wanted)}"
    return f"{text}."
