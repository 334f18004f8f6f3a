"""Files of exported policies: PyTorch's .pt2 and ONNX."""

from __future__ import annotations

import importlib.util
import inspect
import json
import logging
import re
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from torchrl_tit.export.program import Program
from torchrl_tit.extras import install

FACTS = "torchrl_tit.json"
"""Name under which a .pt2 file stores the facts about its policy."""
METADATA = "torchrl_tit"
"""Name under which an ONNX file stores them."""

Run = Callable[[Mapping[str, Tensor]], dict[str, Tensor]]
"""Maps inputs by name to outputs by name."""


@dataclass(frozen=True)
class Format:
    """A file format."""

    write: Callable[[torch.export.ExportedProgram, Mapping[str, Any], Path], None]
    """Writes a program and the facts about its policy, whose "inputs" and "outputs" list its
    tensors in order; raises ValueError if the format cannot express it."""
    read: Callable[[Path], Run]
    """Reads a file as a function from inputs to outputs by name."""
    packages: tuple[str, ...] = ()
    """Packages that it needs."""

    def check_installed(self) -> None:
        """Raises ValueError if a required package is missing."""
        missing = [name for name in self.packages if importlib.util.find_spec(name) is None]
        if missing:
            raise ValueError(
                f"ONNX needs {', '.join(missing)}: {install('onnx')}, or export to .pt2"
            )


def _write_pt2(program: torch.export.ExportedProgram, facts: Mapping[str, Any], path: Path) -> None:
    with path.open("wb") as file:
        torch.export.save(program, file, extra_files={FACTS: json.dumps(facts)})


def _read_pt2(path: Path) -> Run:
    with path.open("rb") as file:
        module = torch.export.load(file).module()
    return lambda inputs: module(**inputs)


def _write_onnx(
    program: torch.export.ExportedProgram, facts: Mapping[str, Any], path: Path
) -> None:
    try:
        with _quiet():
            converted = torch.onnx.export(
                program,
                input_names=list(facts["inputs"]),
                output_names=list(facts["outputs"]),
                verbose=False,
            )
    except Exception as error:  # the exporter's own errors, which have no public base
        raise ValueError(f"{_missing_operator(error)}: export to .pt2 instead") from error
    assert converted is not None
    _require_one_batch_size(converted.model.graph)
    converted.model.metadata_props[METADATA] = json.dumps(facts)
    converted.save(path, external_data=False)


def _read_onnx(path: Path) -> Run:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    try:
        session = onnxruntime.InferenceSession(
            path.read_bytes(), options, providers=["CPUExecutionProvider"]
        )
    except Exception as error:  # its errors have no public base
        raise ValueError(
            f"ONNX Runtime cannot run this policy ({_first_line(error)}): export to .pt2 instead"
        ) from error
    names = [output.name for output in session.get_outputs()]

    def run(inputs: Mapping[str, Tensor]) -> dict[str, Tensor]:
        arrays = session.run(names, {name: x.numpy() for name, x in inputs.items()})
        return dict(zip(names, map(torch.from_numpy, arrays), strict=True))

    return run


FORMATS = {
    "pt2": Format(_write_pt2, _read_pt2),
    "onnx": Format(_write_onnx, _read_onnx, ("onnx", "onnxscript", "onnxruntime")),
}
"""PyTorch's own format, which `torch.export.load` reads, for any device and AOTInductor; and ONNX,
written by PyTorch's exporter for exported programs, which any ONNX runtime reads."""


def find_format(path: Path) -> Format:
    """Returns the format that the suffix of a file's name tells.

    Raises:
        ValueError: if it is unknown.

    Example:
        >>> find_format(Path("agent.onnx")) is FORMATS["onnx"]
        True
    """
    name = path.suffix.removeprefix(".")
    if name not in FORMATS:
        raise ValueError(
            f"the name {path.name!r} tells no format: end it with .{' or .'.join(FORMATS)}"
        )
    return FORMATS[name]


def trace(program: Program) -> torch.export.ExportedProgram:
    """Traces a policy with a free batch size.

    Raises:
        ValueError: if `torch.export` cannot trace it.
    """
    batch = torch.export.Dim("batch")
    examples = program.examples(2)
    try:
        with _quiet(), torch.no_grad():
            exported = torch.export.export(
                _Named(program, list(examples)),
                (),
                examples,
                dynamic_shapes={name: {0: batch} for name in examples},
            )
    except Exception as error:  # each layer of torch.export has its own errors
        raise ValueError(f"torch.export cannot trace this policy: {_first_line(error)}") from error
    exported.example_inputs = None
    for node in exported.graph.nodes:  # half of a small file, with paths of this machine
        for note in ("nn_module_stack", "source_fn_stack", "stack_trace", "torch_fn"):
            node.meta.pop(note, None)
    return exported


class _Named(nn.Module):
    """Takes the inputs of a policy as arguments of these names."""

    def __init__(self, program: Program, names: Sequence[str]) -> None:
        super().__init__()
        self.program = program
        kind = inspect.Parameter.KEYWORD_ONLY
        signature = inspect.Signature([inspect.Parameter(name, kind) for name in names])

        def forward(**inputs: Tensor) -> dict[str, Tensor]:
            return program(inputs)

        forward.__signature__ = signature  # type: ignore[attr-defined]  # what torch.export reads
        self.forward = forward


@contextmanager
def _quiet() -> Iterator[None]:
    """Hides the exporters' own messages."""
    loggers = [logging.getLogger(name) for name in ("torch.onnx", "torch.export", "onnxscript")]
    with ExitStack() as stack:
        for logger in loggers:
            stack.callback(logger.setLevel, logger.level)
            logger.setLevel(logging.ERROR)
        stack.enter_context(warnings.catch_warnings())
        warnings.simplefilter("ignore")
        yield


def _require_one_batch_size(graph: Any) -> None:
    """Makes a graph refuse inputs of different batch sizes, and an empty batch.

    ONNX Runtime does not compare the sizes that a graph names alike, so an input with one row would
    be read for every row, and some of its operators end the process if the batch is empty.
    """
    from onnxscript import ir

    tape = ir.tape.Tape()

    def numbers(*values: int) -> ir.Value:
        return tape.op("Constant", [], {"value_ints": ir.AttrInt64s("value_ints", values)})

    readers = [list(x.uses()) for x in graph.inputs]
    size = tape.op("Shape", [graph.inputs[0]], {"start": 0, "end": 1})
    zeros = tape.op("ConstantOfShape", [size], {"value": ir.tensor([0])})
    # Adds the first of the zeros: an empty batch has none.
    size = tape.op("Add", [size, tape.op("Gather", [zeros, numbers(0)])])
    for x, uses in zip(graph.inputs, readers, strict=True):
        assert x.shape is not None
        shape = tape.op("Concat", [size, numbers(*map(int, x.shape[1:]))], {"axis": 0})
        checked = tape.op("Reshape", [x, shape], {"allowzero": 1})
        checked.shape, checked.dtype = x.shape, x.dtype
        for node, index in uses:
            node.replace_input_with(index, checked)
    graph.insert_before(graph[0], tape.nodes)


def _missing_operator(error: BaseException) -> str:
    """Returns which operator ONNX lacks, if the exporter's error says so."""
    messages: list[str] = []
    cause: BaseException | None = error
    while cause is not None:
        messages.append(str(cause))
        cause = cause.__cause__ or cause.__context__
    found = re.search(
        r"No ONNX function found for <OpOverload\(op='([\w:.]+)'", "\n".join(messages)
    )
    if found:
        return f"ONNX has no operator for {found[1]}"
    return f"this policy cannot be expressed in ONNX ({_first_line(error)})"


def _first_line(error: BaseException) -> str:
    return next((line.strip() for line in str(error).splitlines() if line.strip()), repr(error))
