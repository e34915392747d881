"""Writes logs of Rhoban/bam, which are JSON, as CSV files in the current folder.

python bam_to_csv.py bam/bam/data.bak/raw/*.json
"""

import json
import sys
from pathlib import Path

import pandas as pd

for path in sys.argv[1:]:
    log = json.loads(Path(path).read_text())
    name = f"{log['motor']}_kp{log['kp']}_{log['trajectory']}.csv"
    if Path(name).exists():
        sys.exit(f"{name} exists already; its log has the same motor, gain and trajectory.")
    pd.DataFrame(log["entries"]).to_csv(name, index=False)
