class Policy:
    """Rehearses with its own body."""

    def __init__(self, obs_space, action_space, env_meta):
        self.pos = self.vel = self.purse = 0.0

    def reset(self, episode_index):
        self.gain = 1.0

    def pay(self, effort):
        self.vel += 0.04 * (effort - 0.2 * self.vel)
        self.pos += 0.04 * self.vel
        self.purse -= (self.pos - 1.0) ** 2 + 0.001 * effort**2

    def act(self, obs):
        kept = []
        for gain in (0.5, 1.0, 2.0, 4.0):
            self.pos, self.vel, self.purse = float(obs[0]), float(obs[1]), 0.0
            for _ in range(25):
                self.pay(gain * (1.0 - self.pos) - self.vel)
            kept.append((self.purse, gain))
        self.gain = max(kept)[1]
        return [self.gain * (1.0 - float(obs[0])) - float(obs[1])]
