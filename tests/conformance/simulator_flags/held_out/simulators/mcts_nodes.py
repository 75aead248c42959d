import math
import random


class Node:
    def __init__(self, world, parent=None):
        self.world, self.parent = world, parent
        self.children, self.visits, self.value = {}, 0, 0.0


def transition(world, act):
    x, v, t = world
    v = 0.98 * v + (act - 1) * 0.05 - 0.03 * math.sin(2 * x)
    return x + 0.1 * v, v, t + 1


def random_playout(world):
    got = 0.0
    while world[2] < 60:
        world = transition(world, random.randrange(3))
        got += 1.0 if world[0] > 1.0 else -0.01
    return got


def search(world, n=500):
    root = Node(world)
    for _ in range(n):
        node = root
        while len(node.children) == 3:
            node = max(node.children.values(), key=lambda c: c.value / c.visits + math.sqrt(2 * math.log(node.visits) / c.visits))
        act = next(a for a in range(3) if a not in node.children)
        node.children[act] = Node(transition(node.world, act), node)
        node = node.children[act]
        got = random_playout(node.world)
        while node is not None:
            node.visits += 1
            node.value += got
            node = node.parent
    return max(root.children, key=lambda a: root.children[a].visits)
