def days(field, sow):
    a, b, c = field[0], field[1], field[2]
    b = b + 0.02 * (12.0 * (2 * sow - 1) - 0.4 * b)
    a = a + 0.02 * b
    c = c + 0.02 * a * b
    return [a, b, c]
