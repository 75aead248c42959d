import random
import types


def life(genes):
    me = types.SimpleNamespace(food=1.0, age=0, where=0.0, pace=0.0)
    while me.food > 0 and me.age < 200:
        sees = (me.where, me.pace, me.food)
        push = sum(g * s for g, s in zip(genes, sees))
        me.pace = 0.95 * me.pace + 0.1 * max(-1, min(1, push))
        me.where += me.pace
        me.food -= 0.01 + abs(me.where - 3) * 0.001
        me.age += 1
    return me.age


crowd = [[random.gauss(0, 1) for _ in range(3)] for _ in range(50)]
for _ in range(100):
    crowd.sort(key=life, reverse=True)
    crowd = crowd[:10] + [[g + random.gauss(0, 0.1) for g in random.choice(crowd[:10])] for _ in range(40)]
print(crowd[0])
