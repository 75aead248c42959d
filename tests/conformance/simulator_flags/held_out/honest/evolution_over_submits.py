"""A (1+λ) evolution whose fitness is the mean return of a submit: every evaluation costs episodes."""
import json
import os
import random
import urllib.request
from pathlib import Path


def fitness(numbers, ids):
    Path("system/numbers.json").write_text(json.dumps(numbers))
    request = urllib.request.Request(
        os.environ["EVOPOLICYGYM_SUBMIT_URL"], json.dumps({"env_instances": ids}).encode(), {"Content-Type": "application/json"}
    )
    answer = json.load(urllib.request.urlopen(request))
    return answer["summary"]["mean_return"], answer["remaining_budget"]


mean, sigma, total = [0.0] * 8, 0.5, 0.0
best, left = fitness(mean, [0, 1, 2, 3])
while left >= 4:
    child = [m + sigma * random.gauss(0, 1) for m in mean]
    score, left = fitness(child, [0, 1, 2, 3])
    total += score
    if score > best:
        mean, best, sigma = child, score, sigma * 1.4
    else:
        sigma *= 0.9
print(best, total)
