"""Write the JSON schemas that the package ships: python -m build_scripts.schemas."""

from pathlib import Path

from psa_casadi.report.documents.files import schema_texts

FOLDER = Path(__file__).resolve().parents[1] / "psa_casadi" / "data" / "schemas"


def main() -> None:
    """Write every schema whose text has changed."""
    for name, text in schema_texts().items():
        (FOLDER / name).write_text(text, encoding="utf-8", newline="\n")
        print(FOLDER / name)


if __name__ == "__main__":
    main()
