"""A report shows only the first of many parameters, and says so."""

from npdr_ppl.display.reports.fit_report import MAX_ROWS, parameters_table


def table(count):
    interval = {"mean": 1.0, "sd": 0.1, "hdi_94": [0.8, 1.2]}
    parameters = {f"m{k}": interval for k in range(count)}
    return parameters_table(parameters, units={}, most_likely={}, contraction={})


def test_the_first_of_many_parameters_are_shown():
    assert len(table(MAX_ROWS).rows) == MAX_ROWS and "first" not in table(MAX_ROWS).caption
    assert len(table(MAX_ROWS + 1).rows) == MAX_ROWS
    assert "Only the first 1000 parameters are shown." in table(MAX_ROWS + 1).caption
