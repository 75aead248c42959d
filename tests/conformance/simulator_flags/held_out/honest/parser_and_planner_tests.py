import random
import unittest

from helpers import nearest_free, parse_row, plan_route


class ParserTest(unittest.TestCase):
    def setUp(self):
        self.random = random.Random(4)

    def test_rows(self):
        for _ in range(200):
            values = [self.random.uniform(-5, 5) for _ in range(6)]
            self.assertEqual(parse_row(",".join(map(repr, values))), values)

    def test_routes_are_connected(self):
        total = 0
        for _ in range(100):
            walls = {(self.random.randrange(9), self.random.randrange(9)) for _ in range(20)}
            at = nearest_free(walls, (0, 0))
            for step in plan_route(walls, at, (8, 8)):
                self.assertNotIn(step, walls)
                self.assertLessEqual(abs(step[0] - at[0]) + abs(step[1] - at[1]), 1)
                at = step
                total += 1
        self.assertGreater(total, 0)


if __name__ == "__main__":
    unittest.main()
