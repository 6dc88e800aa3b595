"""Slow twin of M3C2, written from Lague, Brodu and Leroux 2013 (section 3) in plain numpy."""

import numpy as np


def ball_normals(points, cores, radius):
    """Return (counts, normals): the direction of least spread of the points in each ball."""
    counts, normals = [], []
    for core in cores:
        inside = points[np.linalg.norm(points - core, axis=1) <= radius]
        counts.append(len(inside))
        if len(inside) < 3:
            normals.append([np.nan] * 3)
            continue
        centred = inside - inside.mean(0)
        normals.append(np.linalg.eigh(centred.T @ centred)[1][:, 0])
    return np.array(counts), np.array(normals)


def project(points, cores, normals, radius, length, statistic):
    """Return (counts, middles, spreads) along the axis of each core point's cylinder."""
    result = []
    for core, normal in zip(cores, normals, strict=True):
        offset = points - core
        along = offset @ normal
        aside = np.linalg.norm(offset - along[:, None] * normal, axis=1)
        inside = along[(np.abs(along) <= length) & (aside <= radius)]
        if len(inside) == 0 or np.isnan(normal).any():
            result.append((0, np.nan, np.nan))
        elif statistic == "mean":
            spread = inside.std(ddof=1) if len(inside) > 1 else 0.0
            result.append((len(inside), inside.mean(), spread))
        else:
            low, middle, high = np.percentile(inside, [25, 50, 75])
            result.append((len(inside), middle, (high - low) / 1.3489795003921634))
    counts, middles, spreads = zip(*result, strict=True)
    return np.array(counts), np.array(middles), np.array(spreads)


def level_of_detection(sigma_source, n_source, sigma_target, n_target, sigma_registration):
    """Return the 95 % level of detection of differences of means (eq. 1 of the paper)."""
    fit = np.sqrt(sigma_source**2 / n_source + sigma_target**2 / n_target)
    return 1.96 * (fit + sigma_registration)
