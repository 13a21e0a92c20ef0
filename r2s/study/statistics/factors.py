"""How much of the variance of the logarithm of a distance each factor of the study explains.

The design is not balanced, and partly confounded: an approach that works from one scenario only
cannot be told from that scenario. So a factor has two shares: what it explains alone, and what it
adds to all others. Both are adjusted for degrees of freedom, so that a factor without effect has a
share of zero on average. Two confounded factors explain much alone, and add nothing to each other.
"""

import warnings

import pandas as pd
from statsmodels.formula.api import ols
from statsmodels.tools.sm_exceptions import SingularMatrixWarning

FACTORS = ("approach", "solver", "estimated_from", "fabric", "evaluated_on")


def variance_shares(results: pd.DataFrame) -> pd.DataFrame | None:
    """By factor the shares `alone` and `added`, and of all factors together, [-].

    `results`: of one metric, from `frame.labelled`; estimates count whose run did not diverge, the
    mean of the repeats on each recording. None where nothing varies.
    """
    own = results[(results.baseline == "") & (results.approach != "") & results.log.notna()]
    data = own.groupby([*FACTORS, "recording"], observed=True).log.mean().reset_index()
    factors = [name for name in FACTORS if data[name].nunique() > 1]
    if not factors or len(data) < 3 or data.log.var() < 1e-24:
        return None

    def explained(names: list[str]) -> float:
        formula = f"log ~ {' + '.join(f'C({name})' for name in names) or '1'}"
        with warnings.catch_warnings():  # confounded factors make the design singular
            warnings.simplefilter("ignore", SingularMatrixWarning)
            fitted = ols(formula, data).fit()
        return float(fitted.rsquared_adj) if fitted.df_resid > 0 else 1.0

    whole = explained(factors)
    rows = [
        (name, explained([name]), whole - explained([each for each in factors if each != name]))
        for name in factors
    ]
    return pd.DataFrame([*rows, ("all", whole, whole)], columns=["factor", "alone", "added"])
