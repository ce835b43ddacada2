"""CMA-ES (Hansen, *The CMA Evolution Strategy: A Tutorial*, 2016), a peer of gradients."""

from collections.abc import Callable

import numpy as np


def cma_es(
    cost: Callable[[np.ndarray], np.ndarray], n: int, sigma: float, budget: int, size: int = 32
) -> tuple[np.ndarray, int]:
    """The best of a search from zero, and the evaluations; cost is of a population (size, n)."""
    rng, mu = np.random.default_rng(0), size // 2
    w = np.log((size + 1) / 2) - np.log(np.arange(1, mu + 1))
    w /= w.sum()
    many = 1 / (w**2).sum()
    c_s, c_c = (many + 2) / (n + many + 5), (4 + many / n) / (n + 4 + 2 * many / n)
    c_1 = 2 / ((n + 1.3) ** 2 + many)
    c_mu = min(1 - c_1, 2 * (many - 2 + 1 / many) / ((n + 2) ** 2 + many))
    damping = 1 + 2 * max(0.0, np.sqrt((many - 1) / (n + 1)) - 1) + c_s
    length = np.sqrt(n) * (1 - 1 / (4 * n) + 1 / (21 * n**2))
    mean, C, p_c, p_s = np.zeros(n), np.eye(n), np.zeros(n), np.zeros(n)
    best, least, used = mean, np.inf, 0
    while used < budget:
        d, B = np.linalg.eigh(C)
        d = np.sqrt(np.maximum(d, 1e-20))
        steps = rng.normal(size=(size, n)) * d @ B.T
        costs = np.nan_to_num(cost(mean + sigma * steps), nan=np.inf)
        used += size
        order = np.argsort(costs)
        if costs[order[0]] < least:
            least, best = costs[order[0]], mean + sigma * steps[order[0]]
        chosen = steps[order[:mu]]
        move = w @ chosen
        mean = mean + sigma * move
        p_s = (1 - c_s) * p_s + np.sqrt(c_s * (2 - c_s) * many) * (B @ ((B.T @ move) / d))
        calm = np.linalg.norm(p_s) / np.sqrt(1 - (1 - c_s) ** (2 * used / size))
        h = float(calm < (1.4 + 2 / (n + 1)) * length)
        p_c = (1 - c_c) * p_c + h * np.sqrt(c_c * (2 - c_c) * many) * move
        C = (1 - c_1 - c_mu + c_1 * (1 - h) * c_c * (2 - c_c)) * C
        C = C + c_1 * np.outer(p_c, p_c) + c_mu * (chosen.T * w) @ chosen
        sigma *= np.exp(min(1.0, c_s / damping * (np.linalg.norm(p_s) / length - 1)))
    return best, used
