"""M, D, K of an extended model beside those of the hidden system: is any entry biased?"""

import numpy as np

NAMES = ("mass", "damping", "stiffness")


def matrix_deviations(case, diagnosis):
    """(estimate − truth) in standard errors of every entry on and above the diagonal, by "mass[0,0]" and so on.

    Entries without a standard error (held at zero by the structure or by the cone) are left out.
    """
    summary, result = diagnosis.extended, {}
    if summary is None or summary.standard_errors is None:
        return result
    for name, true in zip(NAMES, (case.system.M, case.system.D, case.system.K)):
        found, spread = np.asarray(getattr(summary.model, name)), np.asarray(summary.standard_errors[name])
        for i, j in zip(*np.triu_indices(len(true))):
            if spread[i, j] > 0:
                result[f"{name}[{i},{j}]"] = float((found[i, j] - true[i, j]) / spread[i, j])
    return result


def table_of_matrices(rows):
    """Per matrix, on and off its diagonal: entries within 3 standard errors, mean and spread of the deviations.

    Entries of one record move together: the error of the mean is that of the means of the records.
    """
    print(f"{'entries':28s} {'3 se':>9s} {'median':>8s} {'mean':>8s} {'± error':>8s} {'rms':>6s} {'records':>8s}")
    for name in NAMES:
        for diagonal in (True, False):
            of_records = []
            for row in rows:
                values = [v for key, v in row.get("matrices", {}).items() if _belongs(key, name, diagonal)]
                of_records += [values] if values else []
            if not of_records:
                continue
            everything = np.concatenate(of_records)
            means = np.array([np.mean(values) for values in of_records])
            error = means.std() / np.sqrt(len(means))
            print(
                f"{name + (' on the diagonal' if diagonal else ' beside it'):28s} "
                f"{np.sum(np.abs(everything) <= 3):4d}/{len(everything):<4d} {np.median(everything):8.2f} "
                f"{means.mean():8.2f} {error:8.2f} {np.sqrt(np.mean(everything**2)):6.2f} {len(means):8d}"
            )


def _belongs(key, name, diagonal):
    i, j = key[len(name) + 1 : -1].split(",") if key.startswith(name + "[") else (None, None)
    return i is not None and (i == j) == diagonal
