"""Deformations that carry from one concept to another."""

import torch

from ftl_lightning.data.deformation import Deformations, share_a_path

TIME = torch.linspace(0, 1, 40)
CIRCLE = torch.stack((torch.cos(6 * TIME), torch.sin(6 * TIME)), dim=1)
LINE = torch.stack((TIME, 2 * TIME), dim=1)


def circles(count: int) -> torch.Tensor:
    """Circles of several places, sizes and slants."""
    draw = torch.Generator().manual_seed(0)
    affine = torch.eye(2) + 0.2 * torch.randn(count, 2, 2, generator=draw)
    return CIRCLE @ affine + torch.randn(count, 1, 2, generator=draw)


def test_place_size_and_slant_leave_no_rest_and_a_line_stays_a_line() -> None:
    found = Deformations.fit([circles(6)])
    assert float(found.rest.abs().max()) < 0.02
    chosen = torch.arange(6)
    moved = LINE + found.of(LINE.expand(6, -1, -1), chosen)
    second = moved.diff(n=2, dim=1)
    assert float(second.abs().max()) < 0.02
    assert float(moved.std(dim=0).min()) > 0.1
    curved = CIRCLE.expand(6, -1, -1)
    deviations = circles(6) - circles(6).mean(dim=0)
    torch.testing.assert_close(
        found.of(curved, chosen).var(dim=0).sum(), (deviations * 1.2**0.5).var(dim=0).sum(), rtol=0.3, atol=0
    )


def test_a_changed_pace_is_a_deformation_and_keeps_both_ends() -> None:
    slower = [TIME + share * TIME * (1 - TIME) for share in (-0.2, -0.1, 0.1, 0.2)]
    paths = torch.stack([torch.stack((time.sin(), (3 * time).cos()), dim=1) for time in slower])
    found = Deformations.fit([paths])
    apart = (paths - paths.mean(dim=0)).square().mean()
    assert float(found.rest.square().mean() / apart) < 0.05
    moved = found.of(LINE.expand(4, -1, -1), torch.arange(4)) - found.rest
    ends = moved[:, [0, -1]] - found.shift - (LINE - LINE.mean(dim=0))[[0, -1]] @ found.affine
    assert float(ends.abs().max()) < 1e-5


def test_examples_of_a_single_state_or_of_many_columns_vary_by_shifts_and_scales() -> None:
    draw = torch.Generator().manual_seed(0)
    single = torch.randn(5, 1, 4, generator=draw)
    found = Deformations.fit([single, single + 1])
    assert len(found) == 10
    torch.testing.assert_close(found.of(torch.zeros(5, 1, 4), torch.arange(5)), (single - single.mean(dim=0)) * 1.25**0.5)
    wide = Deformations.fit([torch.randn(6, 20, 12, generator=draw)])
    off = wide.affine - torch.diag_embed(wide.affine.diagonal(dim1=1, dim2=2))
    assert float(off.abs().max()) == 0


def test_where_paths_follow_places_deviations_are_added_as_they_are() -> None:
    paths = circles(4)
    found = Deformations.fit([paths], deform=False)
    added = found.of(LINE.expand(4, -1, -1), torch.arange(4))
    torch.testing.assert_close(added, (paths - paths.mean(dim=0)) * (4 / 3) ** 0.5)


def test_scribbles_share_no_path_but_circles_lines_and_single_states_do() -> None:
    draw = torch.Generator().manual_seed(0)
    scribbles = torch.randn(200, 40, 2, generator=draw).cumsum(dim=1)
    assert not share_a_path(scribbles)
    assert share_a_path(circles(6))
    assert share_a_path(LINE + 0.1 * torch.randn(6, 40, 2, generator=draw))
    assert share_a_path(torch.randn(6, 1, 3, generator=draw))
    huge = Deformations.fit([scribbles]).of(CIRCLE.expand(200, -1, -1), torch.arange(200))
    assert float(huge.abs().amax(dim=(1, 2)).max()) > 5 * float(scribbles.std()), "what such a concept would add to a circle"
