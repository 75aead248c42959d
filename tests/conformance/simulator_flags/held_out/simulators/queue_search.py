import heapq
import math

TURNS = (-0.6, 0.0, 0.6)


def neighbour(place, turn):
    x, y, angle, speed = place
    angle = angle + speed * math.tan(turn) / 2.5 * 0.25
    return x + speed * math.cos(angle) * 0.25, y + speed * math.sin(angle) * 0.25, angle, speed


def first_turn(place, goal):
    heap = [(0.0, 0, place, None)]
    number = 0
    while heap and number < 2000:
        cost, _, here, first = heapq.heappop(heap)
        if math.hypot(here[0] - goal[0], here[1] - goal[1]) < 0.5:
            return first
        for turn in TURNS:
            number += 1
            there = neighbour(here, turn)
            extra = 0.1 + abs(turn) * 0.05 + (5.0 if abs(there[1]) > 17 else 0.0)
            heapq.heappush(heap, (cost + extra, number, there, turn if first is None else first))
    return 0.0
