"""A substitute for the command `psa` in tests of the workbench: a real process like it."""

import json
import sys
import time
from pathlib import Path

from psa_casadi.common.children import end_with_parent

TRIED = {"evidence": 0.0, "score": 0.0, "rms_m": 2e-7, "holdout_rms_m": 2e-7, "base_rms_m": 2e-7,
         "noise_rms_m": 1e-8}  # fmt: skip


def main() -> None:
    end_with_parent()
    words = sys.argv[1:]
    Path("words.txt").write_text("\n".join(words), encoding="utf-8")
    if words[0] == "export":
        Path("extended.fmu").write_bytes(b"PK")
        return
    row = json.dumps({"state": "finished", "causes": [], **TRIED})
    sys.stderr.write("diagnosing ...\n")
    sys.stderr.flush()
    try:
        # who reads it may stop this process at once
        Path("events.jsonl").write_text(f"{row}\n", encoding="utf-8")
        for _ in range(600):
            if Path("let_go").exists():
                break
            time.sleep(0.05)
    except KeyboardInterrupt:
        Path("extended.json").write_text("{}", encoding="utf-8")
        sys.stderr.write("Interrupted: kept.\n")
        sys.exit(130)
    Path("extended.json").write_text("{}", encoding="utf-8")
    Path("diagnosis.json").write_text('{"verdict": "adequate", "causes": []}', encoding="utf-8")
    Path("report.html").write_text("<p>report</p>", encoding="utf-8")
    sys.stdout.write("verdict    adequate\n")


if __name__ == "__main__":
    main()
