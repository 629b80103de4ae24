"""How often ``bevviz why --robot`` names the node that lost an object, on generated graphs of eight nodes.

``python -m benchmarks.robot_chain --graphs 60``. Each graph has 16 planted losses: a node drops, renames,
moves or delays an object, or loses its message. Processor time is that of one thread.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter

from benchmarks.measure import machine
from bevviz.extras.robot_chain.chain import RobotChain, verdict
from tests.support.robot_graphs import PARENT, TOPICS, make_graph


def main() -> None:
    """Print the results."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--graphs", type=int, default=60, help="number of graphs (default: 60)")
    parser.add_argument("--seed", type=int, default=1000, help="seed of the first graph (default: 1000)")
    options = parser.parse_args()
    parents = {TOPICS[node]: {TOPICS[parent]} for node, parent in PARENT.items()}
    parents["/merged"].add("/camera/objects")
    asked, right, kinds = Counter[str](), Counter[str](), 0
    made_right = frames = 0
    inferring = asking = 0.0
    for seed in range(options.seed, options.seed + options.graphs):
        graph = make_graph(seed)
        start = time.thread_time()
        chain = RobotChain(graph.messages, graph.sensors)
        inferring += time.thread_time() - start
        frames += len(graph.sensors["/points"])
        made_right += sum(set(chain[topic].parents) == those for topic, those in parents.items())
        for plant in graph.plants:
            start = time.thread_time()
            found = verdict(chain.follow(*graph.places[plant]))
            asking += time.thread_time() - start
            asked[plant.node] += 1
            if found is not None and found.topic == TOPICS[plant.node]:
                right[plant.node] += 1
                kinds += found.state == plant.kind or found.state == "not made"
    print(machine())
    total = sum(asked.values())
    print(f"right node: {sum(right.values())} of {total}; with the right reason: {kinds}")
    print("by node: " + ", ".join(f"{node} {right[node]} of {asked[node]}" for node in asked))
    print(f"topics with the right parents: {made_right} of {options.graphs * len(parents)}")
    print(f"{1e3 * inferring / frames:.2f} ms a frame to infer, {1e3 * asking / total:.2f} ms a question")


if __name__ == "__main__":
    main()
