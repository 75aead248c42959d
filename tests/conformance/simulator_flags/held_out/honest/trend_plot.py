import json
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

figure, axes = plt.subplots(2)
average = None
for path in sorted(Path("feedback").glob("submit_*/summary.json")):
    summary = json.loads(path.read_text())
    if summary["returns"] is None:
        continue
    mean = float(np.mean(summary["returns"]))
    average = mean if average is None else 0.7 * average + 0.3 * mean
    axes[0].plot(summary["submit_index"], mean, "o", summary["submit_index"], average, "x")
    axes[1].plot(np.cumsum(np.sort(summary["returns"])) / np.arange(1, len(summary["returns"]) + 1))
figure.savefig("trend.png")
