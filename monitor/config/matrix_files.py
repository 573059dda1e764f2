"""Matrices of a structure that are stored in separate files (NumPy, JSON, Matrix Market)."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from monitor.core import BadConfigurationError, MissingInputError

_KEYS = ("mass_matrix", "stiffness_matrix", "stiffness_derivatives")


def read_matrices(table: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Replace file names in a ``[structure]`` table by the matrices that the files hold.

    A file whose name ends in ``.npz`` (NumPy) or ``.json`` holds the matrix under the name of the key.  A file whose name ends
    in ``.mtx`` (Matrix Market) holds one matrix.  `stiffness_derivatives` may be a list of such names.  Names are relative to
    `folder`; the matrices are lists of rows, in the units of the table.
    """

    def resolved(key: str, value: Any) -> Any:
        if isinstance(value, str):
            return _read(folder / value, key)
        return [resolved(key, v) for v in value] if isinstance(value, list) and key == _KEYS[2] else value

    return {key: resolved(key, value) if key in _KEYS else value for key, value in table.items()}


def _read(path: Path, key: str) -> Any:
    try:
        if path.suffix == ".npz":
            with np.load(path, allow_pickle=False) as arrays:
                return arrays[key].tolist()
        if path.suffix == ".json":
            return json.loads(path.read_text(encoding="utf-8"))[key]
        if path.suffix == ".mtx":
            from scipy.io import mmread  # imported here: it loads SciPy's sparse matrices, which nothing else needs

            matrix = mmread(path)
            return (matrix if isinstance(matrix, np.ndarray) else matrix.toarray()).tolist()
    except OSError as error:
        raise MissingInputError(f"{path}: {error.strerror or error}") from error
    except KeyError as error:
        raise BadConfigurationError(f"{path}: holds no {key!r}") from error
    except (ValueError, TypeError, RecursionError, zipfile.BadZipFile) as error:
        raise BadConfigurationError(f"{path}: unreadable as {path.suffix}: {error}") from error
    raise BadConfigurationError(f"{path}: matrices are read from .npz, .json and .mtx files")
