def make_toy(x, v):
    score = 0.0

    def tick(push):
        nonlocal x, v, score
        v = 0.9 * v + 0.1 * push
        x = max(-2.0, min(2.0, x + v))
        score -= abs(x - 0.3)
        return x, v

    def result():
        return score

    return tick, result


def evaluate(kp, kd):
    tick, result = make_toy(1.0, 0.0)
    x, v = 1.0, 0.0
    for _ in range(100):
        x, v = tick(-kp * x - kd * v)
    return result()


GAINS = max(((kp, kd) for kp in range(10) for kd in range(10)), key=lambda g: evaluate(*g))
