"""What the scripts of this folder share: they find diswm.py, and a mistake is one line."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import diswm  # noqa: E402


def run_script(main):
    """Run a script's main as its command line does."""
    try:
        main()
    except diswm.UserError as error:
        print("error:", " ".join(str(error).split()), file=sys.stderr)
        sys.exit(2 if isinstance(error, diswm.UsageError) else 1)
    except OSError as error:
        sys.exit(f"error: {error}")
