from dataclasses import dataclass, replace
from math import cos, sin


@dataclass(frozen=True)
class Scene:
    x: float
    xd: float
    th: float
    thd: float

    def after(self, f):
        t = (f + 0.05 * self.thd**2 * sin(self.th)) / 1.1
        a = (9.8 * sin(self.th) - cos(self.th) * t) / (0.6667 - 0.0455 * cos(self.th) ** 2)
        return replace(self, x=self.x + 0.02 * self.xd, xd=self.xd + 0.02 * (t - 0.0455 * a * cos(self.th)),
                       th=self.th + 0.02 * self.thd, thd=self.thd + 0.02 * a)


def frames_standing(scene, k1, k2):
    frames = 0
    while abs(scene.th) < 0.21 and abs(scene.x) < 2.4 and frames < 500:
        scene = scene.after(10.0 if k1 * scene.th + k2 * scene.thd > 0 else -10.0)
        frames += 1
    return frames


if __name__ == "__main__":
    grid = [(i / 4, j / 4) for i in range(20) for j in range(20)]
    print(sorted(grid, key=lambda k: frames_standing(Scene(0, 0, 0.05, 0), *k))[-1])
