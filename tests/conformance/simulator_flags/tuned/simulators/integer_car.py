"""All in millionths, so nothing here is a float."""
WAVE = [round(1e6 * (1 - (k / 500) ** 2 / 2)) for k in range(-600, 600)]


def errands(p, q, key):
    n = 0
    while p < 450_000 and n < 999:
        w = key if q >= 0 else -key
        q += (1500 * w - 2500 * WAVE[(3 * p // 1000) % 1200]) // 1_000_000
        q = sorted((-70_000, q, 70_000))[1]
        p = max(-1_200_000, p + q)
        n += 1
    return n


KEY = min(range(100_000, 1_000_001, 50_000), key=lambda key: errands(-500_000, 0, key))
