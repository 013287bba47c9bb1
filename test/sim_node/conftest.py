from __future__ import annotations

import pytest


@pytest.fixture(scope="session")
def env():
    from sim_node.env import LiberoEnv

    env = LiberoEnv()
    yield env
    env.close()
