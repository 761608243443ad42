"""Every agent in a process of its own: nothing but packets passes between them, and the result is the same."""

from __future__ import annotations

import multiprocessing
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from duagc.pipeline.base import determinism
from duagc.pipeline.config.exchange import ExchangeConfig
from duagc.pipeline.config.network import LinkConfig
from duagc.pipeline.exchange.map_agent import MapAgent
from duagc.pipeline.exchange.rounds import Delivery, due
from duagc.pipeline.exchange.session import run_session_of
from duagc.pipeline.exchange.session_result import result_of
from duagc.pipeline.network import link_model
from duagc.pipeline.network.link_model import LinkModel
from tests.exchange.conftest import robot
from tests.fixtures.results import same

NAMES = ("alpha", "bravo", "charlie")
CONFIG = ExchangeConfig(link=LinkConfig(topology="chain", loss_probability=0.3))


def live(pipe: Connection, place: int) -> None:
    """A robot's whole life: it makes its own data, and knows its name, its neighbors and the settings."""
    determinism.configure_opencv()
    data, _ = robot(NAMES[place], 0.6 * place, keyframes=4)
    agent = MapAgent(data, NAMES, link_model.neighbors(CONFIG.link, NAMES)[NAMES[place]], CONFIG, seed=0)
    while (heard := pipe.recv()) is not None:
        sent = [(out.receiver, out.packet) for out in agent.tick(*heard)]
        pipe.send((sent, agent.done))
    pipe.send(result_of(agent))
    pipe.close()


def carry(pipes: dict[str, Connection]) -> None:
    """The air between the processes, until everybody is done."""
    model = LinkModel(CONFIG.link, 0)
    waiting: dict[str, list[Delivery]] = {name: [] for name in pipes}
    for round_index in range(CONFIG.max_rounds):
        now_ns = round_index * CONFIG.period_ns
        for name, pipe in pipes.items():
            pipe.send((round_index, due(waiting[name], now_ns)))
        answers = {name: pipe.recv() for name, pipe in pipes.items()}
        for sender, (sent, _) in answers.items():
            for receiver, packet in sent:
                sequence = int.from_bytes(packet[8:12], "little")
                fate = model.fate(sender, receiver, sequence=sequence, send_ns=now_ns, size=len(packet))
                waiting[receiver].extend((at_ns, sender, sequence, packet) for at_ns in fate.deliver_ns)
        if all(done for _, done in answers.values()):
            return
    raise AssertionError("the session did not end")


def test_agents_in_separate_processes_end_the_same_bit_for_bit(tmp_path: Path) -> None:
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__])  # imports once, and nothing else, for the three of them
    pipes: dict[str, Any] = {}
    processes = []
    for place, name in enumerate(NAMES):
        pipes[name], theirs = context.Pipe()
        processes.append(context.Process(target=live, args=(theirs, place), daemon=True))
        processes[-1].start()
    carry(pipes)
    apart = {}
    for name, pipe in pipes.items():
        pipe.send(None)
        apart[name] = pipe.recv()
    for process in processes:
        process.join(timeout=30)
        assert process.exitcode == 0
    together = run_session_of(
        [robot(name, 0.6 * place, keyframes=4)[0] for place, name in enumerate(NAMES)],
        CONFIG,
        seed=0,
        exchange_path=tmp_path / "exchange.mcap",
        consensus_path=tmp_path / "consensus.mcap",
    )
    for name in NAMES:
        assert apart[name].component == NAMES
        assert apart[name].converged
        assert same(apart[name], together[name])
