"""Submits with increasing batches and backs off when the service is busy."""
import json
import os
import time
import urllib.error
import urllib.request


def post(ids):
    delay = 0.5
    for attempt in range(8):
        request = urllib.request.Request(
            os.environ["EVOPOLICYGYM_SUBMIT_URL"], json.dumps({"env_instances": ids}).encode(), {"Content-Type": "application/json"}
        )
        try:
            return json.load(urllib.request.urlopen(request))
        except urllib.error.HTTPError as error:
            if error.code != 429:
                raise
            time.sleep(delay)
            delay = min(30.0, delay * 2)
    raise SystemExit("busy")


left, size, best = 128, 4, None
gain, spread = 1.0, 0.5
while left >= size:
    answer = post(list(range(size)))
    left -= size
    score = answer["summary"]["mean_return"]
    if best is None or score > best:
        best, gain = score, gain + spread
    else:
        spread = -0.6 * spread
    size = min(16, int(size * 1.5))
print(best, gain)
