"""Writes `docs/reference/files.md` from the files' types: `python docs/_site/files.py > docs/reference/files.md`."""

from evopolicy_gateway.cli import schemas

if __name__ == "__main__":
    print(schemas.page())
