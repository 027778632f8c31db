"""What the scripts of this folder share: they find diswm.py, and a mistake is one line."""

import sys
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import diswm  # noqa: E402


def first_window(run, model):
    """The 50 rows with which a run's last episode begins, as a batch of one window."""
    actions = model.rssm.action_dim
    dtype = diswm.agent_row(actions) if actions else diswm.VIDEO_ROW
    replay = diswm.Replay(run / "episodes", dtype)
    if not replay.paths:
        raise diswm.UserError(f"no episodes in {replay.folder}; nothing to measure")
    rows = replay.read(replay.paths[-1])[:50]
    batch = {name: np.array(rows[name])[None] for name in dtype.names}
    return diswm.to_device(batch, model.cfg.device)

def run_script(main):
    """Run a script's main as its command line does."""
    sys.stdout.reconfigure(errors="backslashreplace")  # a Latin-1 terminal has no β
    try:
        main()
    except diswm.UserError as error:
        print("error:", " ".join(str(error).split()), file=sys.stderr)
        sys.exit(2 if isinstance(error, diswm.UsageError) else 1)
    except (ImportError, OSError, torch.OutOfMemoryError) as error:
        sys.exit(f"error: {error}".split("\n")[0])
    except KeyboardInterrupt:
        sys.exit(130)
