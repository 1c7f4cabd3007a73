"""Runs a notebook from top to bottom, and reports its output.

Usage: run_notebook.py NOTEBOOK, with SCI_RECON_URL and PYTHONPATH. Prints one JSON line with the output types of
each code cell, and the printed text.
"""

import json
import sys
import tempfile

import nbclient
import nbformat


def main():
    notebook = nbformat.read(sys.argv[1], as_version=4)
    nbformat.validate(notebook)
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert not any(cell.outputs or cell.execution_count for cell in cells), "the notebook must be stored without outputs"
    with tempfile.TemporaryDirectory() as folder:
        client = nbclient.NotebookClient(notebook, timeout=300, resources={"metadata": {"path": folder}})
        client.execute()
    kinds = [[kind for output in cell.outputs for kind in output.get("data", {})] for cell in cells]
    printed = "".join(
        output.text for cell in cells for output in cell.outputs if output.get("name") == "stdout"
    )
    print(json.dumps({"kinds": kinds, "printed": printed}))


main()
