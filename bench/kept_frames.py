"""Rendered images of the bench, kept on disk: rendering takes far longer than what is measured on it."""

from collections.abc import Iterator
from dataclasses import astuple
from pathlib import Path

import numpy as np
import numpy.typing as npt

from knee_gap_simulation.knee_simulator import KneeSimulator, SimulatorFrame
from knee_gap_simulation.scope.imaging import decoded


def frames_of(
    simulator: KneeSimulator, folder: Path | None, start: int = 0, step: int = 1
) -> Iterator[SimulatorFrame]:
    """Every `step`-th image of a bench: from the folder where all are kept there, else rendered and kept."""
    if folder is None:
        yield from simulator.frames(start, None, step)
        return
    settings = simulator.settings
    level = "".join(map(str, astuple(settings.difficulty)))
    name = f"{level}_{settings.seed}_{settings.travel_direction}_{settings.duration_s:g}_{settings.fps:g}"
    # The exposure follows from image to image: every fourth one is not a fourth of all.
    name += f"_{start}_{step}" if (start, step) != (0, 1) else ""
    name += "_closed" if settings.gap is None else ""
    name += "" if settings.appearance == "plain" else f"_{settings.appearance}"
    kept = folder / name
    files = [kept / f"{index:05d}.npz" for index in range(start, simulator.frame_count, step)]
    if all(file.exists() for file in files):
        yield from map(_load, files)
        return
    kept.mkdir(parents=True, exist_ok=True)
    for file, frame in zip(files, simulator.frames(start, None, step), strict=True):
        _save(file, frame)
        yield frame


def _save(file: Path, frame: SimulatorFrame) -> None:
    unfinished = file.with_suffix(".part")
    with unfinished.open("wb") as stream:
        np.savez_compressed(
            stream,
            index=frame.index,
            stamp_ns=frame.stamp_ns,
            jpeg=np.frombuffer(frame.jpeg, np.uint8),
            T_world_lens=frame.T_world_lens,
            T_world_lens_tracked=frame.T_world_lens_tracked,
            gap_mask=np.packbits(frame.gap_mask),
            shape=frame.gap_mask.shape,
            debris_cover=frame.debris_cover,
            probe=frame.probe,
            instrument_mask=np.packbits(frame.instrument_mask),
        )
    # A run that is broken off leaves no file that looks whole.
    unfinished.rename(file)


def _load(file: Path) -> SimulatorFrame:
    with np.load(file) as kept:
        jpeg, shape = kept["jpeg"].tobytes(), tuple(int(side) for side in kept["shape"])
        return SimulatorFrame(
            index=int(kept["index"]),
            stamp_ns=int(kept["stamp_ns"]),
            jpeg=jpeg,
            image=decoded(jpeg),
            T_world_lens=kept["T_world_lens"],
            T_world_lens_tracked=kept["T_world_lens_tracked"],
            gap_mask=_mask(kept["gap_mask"], shape),
            debris_cover=kept["debris_cover"],
            probe=kept["probe"],
            instrument_mask=_mask(kept["instrument_mask"], shape),
        )


def _mask(packed: npt.NDArray[np.uint8], shape: tuple[int, ...]) -> npt.NDArray[np.bool_]:
    return np.unpackbits(packed)[: shape[0] * shape[1]].reshape(shape).astype(bool)
