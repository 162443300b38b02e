"""The paper's Table 2, with two misprints corrected, and numbers for its adverbs."""

from ffsm_drake.plugins.paper.runs import STUDY

CITATION: str = STUDY["citation"]
# metric -> disturbance -> controller -> value, corrected
TABLE_2: dict[str, dict[str, dict[str, float]]] = STUDY["table_2"]
# (metric, disturbance, controller) -> the misprint, and the reason for its correction
CORRECTIONS: dict[tuple[str, str, str], str] = {
    (each["metric"], each["disturbance"], each["controller"]): each["why"]
    for each in STUDY["corrections"]
}

# Interpretation of the paper's adverbs.
NEARLY_TENFOLD = 5.0  # "nearly one order of magnitude": at least this factor
SLIGHTLY = 0.05  # "slightly larger": by at most this fraction
NOTICEABLE = 0.02  # smaller effects count as none
REPRODUCED = 0.03  # largest deviation of a reproduced table, as a fraction
LOCALLY = 0.5  # "only locally": in less than this fraction of time and coordinates
PRECISELY = 1e-5  # "high precision": largest final error, rad and m
ACCURATELY = 0.1  # "accurately estimated": largest relative error
