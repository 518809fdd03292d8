import os
import resource
import signal
from contextlib import suppress

import pytest
import torch
from safetensors.torch import save_file
from torch import nn

from visadapt.learning.training_state import CHECKPOINT_ITERATIONS, TrainingState
from visadapt.policies import StatePolicy
from visadapt.storage.checkpoints import (
    TREE_KEY,
    CheckpointError,
    load_network,
    load_tree,
    load_weights,
    save_network,
    save_tree,
)


def same(one, other):
    """Equal, with equal types and keys, down to the tensors."""
    if isinstance(one, torch.Tensor):
        return isinstance(other, torch.Tensor) and one.dtype == other.dtype and torch.equal(one, other)
    if isinstance(one, dict):
        return (
            isinstance(other, dict)
            and [(type(key), key) for key in one] == [(type(key), key) for key in other]
            and all(same(one[key], other[key]) for key in one)
        )
    if isinstance(one, list):
        return isinstance(other, list) and len(one) == len(other) and all(map(same, one, other))
    return type(one) is type(other) and one == other


class TestTrees:
    def test_a_tree_is_read_as_it_was_written(self, tmp_path):
        tree = {
            "by number": {0: torch.arange(3), 10: {"deep": [torch.tensor(0.5, dtype=torch.float64), None]}},
            "nothing": None,
            "flags": [True, False],
            "numbers": [1, 1.0, 0.1 + 0.2, -1e-300, float("inf")],
            "text": 'a "quoted" line\nand another, é',
            "empty": [{}, [], ""],
            "tensors": [
                torch.zeros(2, 0, 1),
                torch.tensor([True, False]),
                torch.arange(4, dtype=torch.uint8),
                torch.tensor(7),
            ],
        }
        save_tree(tmp_path / "tree.safetensors", tree)
        assert same(load_tree(tmp_path / "tree.safetensors"), tree)

    def test_tensors_that_share_memory_or_are_transposed_keep_their_values(self, tmp_path):
        whole = torch.arange(12.0).reshape(3, 4)
        tree = {"whole": whole, "again": whole, "part": whole[1:], "turned": whole.T, "row": whole[0].expand(2, 4)}
        save_tree(tmp_path / "t.safetensors", tree)
        assert same(load_tree(tmp_path / "t.safetensors"), tree)

    def test_a_tree_without_tensors(self, tmp_path):
        save_tree(tmp_path / "t.safetensors", {"a": 1})
        assert load_tree(tmp_path / "t.safetensors") == {"a": 1}

    def test_an_optimiser_goes_on_from_its_file_to_the_same_numbers(self, tmp_path):
        def steps(layer, optimiser, count):
            for k in range(count):
                optimiser.zero_grad()
                (layer(torch.full((1, 3), 0.1 * k)) - 1).square().sum().backward()
                optimiser.step()

        torch.manual_seed(0)
        layer = nn.Linear(3, 2)
        optimiser = torch.optim.Adam(layer.parameters(), 0.1)
        steps(layer, optimiser, 5)
        save_tree(tmp_path / "t.safetensors", {"layer": layer.state_dict(), "optimiser": optimiser.state_dict()})
        tree = load_tree(tmp_path / "t.safetensors")
        other = nn.Linear(3, 2)
        other.load_state_dict(tree["layer"])
        resumed = torch.optim.Adam(other.parameters(), 0.7)
        resumed.load_state_dict(tree["optimiser"])
        for pair in ((layer, optimiser), (other, resumed)):
            steps(*pair, 5)
        assert torch.equal(layer.weight, other.weight)

    def test_a_training_generator_goes_on_where_it_was(self, tmp_path):
        generator = torch.Generator().manual_seed(3)
        torch.rand(5, generator=generator)
        save_tree(tmp_path / "t.safetensors", {"generator": generator.get_state()})
        wanted = torch.rand(5, generator=generator)
        other = torch.Generator()
        other.set_state(load_tree(tmp_path / "t.safetensors")["generator"])
        assert torch.equal(torch.rand(5, generator=other), wanted)

    def test_what_no_tree_can_hold_is_refused_and_the_old_file_survives(self, tmp_path):
        path = tmp_path / "t.safetensors"
        save_tree(path, {"a": 1})
        with pytest.raises(TypeError, match="not object"):
            save_tree(path, {"a": 2, "b": [object()]})
        assert load_tree(path) == {"a": 1}
        assert list(tmp_path.iterdir()) == [path]

    def test_a_write_that_is_cut_short_leaves_the_old_file_and_nothing_else(self, tmp_path):
        path = tmp_path / "t.safetensors"
        save_tree(path, {"a": 1})
        soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, hard))
        try:
            with pytest.raises(Exception, match="File too large"):
                save_tree(path, {"a": torch.zeros(100_000)})
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        assert load_tree(path) == {"a": 1}
        assert list(tmp_path.iterdir()) == [path]

    def test_what_a_process_leaves_that_is_killed_as_it_writes_is_removed_by_the_next(self, tmp_path):
        path = tmp_path / "t.safetensors"
        save_tree(path, {"a": 1})
        if (child := os.fork()) == 0:
            try:
                signal.signal(signal.SIGXFSZ, signal.SIG_DFL)  # a limit on the size of files then kills
                resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
                resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, 10_000))
                save_tree(path, {"a": torch.zeros(100_000)})
            finally:
                os._exit(0)
        assert os.waitpid(child, 0)[1] == signal.SIGXFSZ
        assert len(list(tmp_path.iterdir())) == 2
        assert load_tree(path) == {"a": 1}
        save_tree(path, {"a": 2})
        assert list(tmp_path.iterdir()) == [path]


class TestBadFiles:
    def test_each_is_one_line_that_names_the_file(self, tmp_path):
        whole = tmp_path / "whole.safetensors"
        save_tree(whole, {"a": torch.zeros(100)})
        names = ("missing", "torn", "beheaded", "empty", "text", "foreign")
        paths = {name: tmp_path / f"{name}.safetensors" for name in names}
        paths["torn"].write_bytes(whole.read_bytes()[:-10])
        paths["beheaded"].write_bytes(whole.read_bytes()[:20])
        paths["empty"].write_bytes(b"")
        paths["text"].write_text("not a checkpoint, but long enough to hold a header's length")
        save_file({"a": torch.zeros(1)}, paths["foreign"])
        says = dict.fromkeys(names, "not a complete safetensors file")
        says |= {"missing": "there is no such checkpoint", "foreign": "that visadapt did not write"}
        for name, path in paths.items():
            with pytest.raises(CheckpointError, match=says[name]) as caught:
                load_tree(path)
            assert str(caught.value).startswith(f"{path}: ")
            assert "\n" not in str(caught.value)

    @pytest.mark.parametrize(
        ("tree", "says"),
        [
            ("{", "is incomplete or of another kind"),
            ('{"list": ' * 3000, "is incomplete or of another kind"),
            ("[1]", "is damaged: its checksum"),
            ('{"tensor": "7"}', "is incomplete or of another kind: has no '7'"),
            ('{"dict": [["a"]]}', "is incomplete or of another kind"),
        ],
    )
    def test_a_tree_that_is_none(self, tmp_path, tree, says):
        path = tmp_path / "t.safetensors"
        save_file({"0": torch.zeros(1)}, path, {TREE_KEY: tree})
        with pytest.raises(CheckpointError, match=f"^{path}: {says}") as caught:
            load_tree(path)
        assert "\n" not in str(caught.value)

    def test_a_folder(self, tmp_path):
        with pytest.raises(CheckpointError, match=f"^{tmp_path}: cannot be read: Is a directory"):
            load_tree(tmp_path)

    def test_a_flipped_bit_anywhere_is_told_or_changes_nothing(self, tmp_path):
        path, tree = tmp_path / "t.safetensors", {"a": torch.arange(30.0), "settings": {"seed": 1}}
        save_tree(path, tree)
        whole = path.read_bytes()
        for place in range(len(whole)):
            damaged = bytearray(whole)
            damaged[place] ^= 1 << place % 8
            path.write_bytes(damaged)
            with suppress(CheckpointError):
                assert same(load_tree(path), tree), place

    @pytest.mark.parametrize(
        ("name", "value"),
        [
            ("generator", None),
            ("generator", torch.zeros(3, dtype=torch.uint8)),
            ("optimiser", None),
            ("optimiser", {}),
            ("network", None),
            ("losses", None),
        ],
    )
    def test_a_training_state_that_lacks_something(self, tmp_path, name, value):
        def state():
            network, path = nn.Linear(2, 1), tmp_path / "t.safetensors"
            adam = torch.optim.Adam(network.parameters())
            return TrainingState(network, adam, torch.Generator(), 0.1, CHECKPOINT_ITERATIONS, None, path)

        whole = state()
        for _ in range(CHECKPOINT_ITERATIONS):
            whole.descend(whole.network(torch.ones(1, 2)).sum())
        whole.keep({})
        tree = load_tree(whole.path)
        save_tree(whole.path, {**tree, name: value})
        with pytest.raises(CheckpointError, match=r"t.safetensors: is incomplete or of another kind"):
            state().resume()


class TestNetworks:
    def test_a_network_is_read_with_its_settings(self, tmp_path):
        path = tmp_path / "p.safetensors"
        torch.manual_seed(0)
        policy, other = StatePolicy(4), StatePolicy(4)
        save_network(path, policy, {"seed": 3, "spread": (0.1, 0.2), "rate": 1e-3})
        assert load_network(path, other) == {"seed": 3, "spread": [0.1, 0.2], "rate": 1e-3}
        for key, value in policy.state_dict().items():
            assert torch.equal(value, other.state_dict()[key]), key

    def test_a_network_of_another_class_is_refused(self, tmp_path):
        save_network(tmp_path / "p.safetensors", nn.Linear(2, 2), {})
        with pytest.raises(CheckpointError, match=r"p\.safetensors: holds a Linear, a StatePolicy is needed"):
            load_network(tmp_path / "p.safetensors", StatePolicy(4))

    @pytest.mark.parametrize("tree", [{"weights": {}}, [1, 2], None])
    def test_a_checkpoint_of_something_else_is_refused(self, tree, tmp_path):
        save_tree(tmp_path / "p.safetensors", tree)
        with pytest.raises(CheckpointError, match="not of a network"):
            load_network(tmp_path / "p.safetensors", StatePolicy(4))

    @pytest.mark.parametrize(
        ("other", "says"),
        [
            (nn.Linear(3, 2), r"weight is \(2, 4\) torch\.float32, this network needs \(2, 3\) torch\.float32"),
            (
                nn.Linear(4, 2).double(),
                r"weight is \(2, 4\) torch\.float32, this network needs \(2, 4\) torch\.float64",
            ),
            (nn.Linear(4, 2, bias=False), r"bias is \(2,\) torch\.float32, this network needs none of that name"),
        ],
    )
    def test_another_architecture_is_named_and_nothing_is_loaded(self, other, says, tmp_path):
        path = tmp_path / "n.safetensors"
        save_network(path, nn.Linear(4, 2), {})
        before = {key: value.clone() for key, value in other.state_dict().items()}
        with pytest.raises(CheckpointError, match=f"^{path}: made for another architecture: {says}$"):
            load_network(path, other)
        for key, value in before.items():
            assert torch.equal(value, other.state_dict()[key]), key

    def test_a_missing_key_is_named_and_the_keys_before_it_are_not_loaded(self, tmp_path):
        layer = nn.Linear(4, 2)
        before = layer.weight.detach().clone()
        with pytest.raises(CheckpointError, match="bias is missing"):
            load_weights(layer, {"weight": torch.zeros(2, 4)}, tmp_path)
        assert torch.equal(layer.weight, before)
