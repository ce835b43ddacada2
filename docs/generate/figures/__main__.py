"""`python -m docs.generate.figures`: writes, checks or lists the figures."""

import argparse
import sys

from docs.generate.figures import FIGURES, ROOT, __doc__, differing, figure, files, renewed


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--check", action="store_true", help="list what differs, write nothing")
    parser.add_argument("--list", action="store_true", help="print every figure")
    chosen = parser.parse_args()
    if chosen.list:
        print("\n".join(f"{name:48} {figure(name)}" for name in FIGURES))
    elif chosen.check:
        found = differing()
        print("\n".join(found))
        sys.exit(bool(found))
    else:
        for path in files():
            before = path.read_text()
            if (after := renewed(before)) != before:
                path.write_text(after)
                print(path.relative_to(ROOT))


if __name__ == "__main__":
    main()
