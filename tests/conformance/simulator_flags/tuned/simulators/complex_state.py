import cmath

STEP = 0.04


def future(z, gain):
    loss = 0.0
    for _ in range(40):
        u = max(-1.0, min(1.0, -gain * z.imag))
        z = complex(z.real + STEP * z.imag, z.imag + STEP * (u + 4.9 * cmath.sin(z.real).real))
        loss += z.real**2 + 0.01 * u * u
    return loss


class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        pass

    def reset(self, episode_index):
        self.gain = None

    def act(self, obs):
        z = complex(obs[0], obs[1])
        self.gain = min((1, 2, 4, 8, 16), key=lambda gain: future(z, gain))
        return [-self.gain * z.imag]
