def gain(table):
    return sum(table) / len(table) if table else 0.0
