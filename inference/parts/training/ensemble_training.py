"""Training of an ensemble of density estimators, all members in one pass.

The members' weights are stacked, and one vectorised call evaluates all of them on their own
mini-batches. With small networks most of a step's time goes into starting kernels, which is then
done once for all members.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.func import functional_call, stack_module_state, vmap

from npdr_ppl.errors import BackendError

__all__ = [
    "Evaluator",
    "Fit",
    "LogProb",
    "Loss",
    "TrainingOptions",
    "in_turn",
    "train",
    "vectorised",
]

LogProb = Callable[[Tensor, Tensor], Tensor]
"""Function for the log densities of all members, with u's leading shape. It takes whitened
parameters u, ``(members, n, d)``, or several for each context, ``(members, n, atoms, d)``, and
features f, ``(members, n, ...)``."""

Evaluator = Callable[[nn.Module, dict[str, Tensor], dict[str, Tensor]], LogProb]
"""Function that makes the log densities of all members. It takes one of their networks and their
stacked parameters and buffers by name, each ``(members, ...)``."""

Loss = Callable[[LogProb, Tensor], Tensor]
"""Function for the losses of the rows whose indices are the second argument, ``(members, n)`` to
``(members, n)``. Rows come in random order, so that a row's neighbours are a random sample of the
others."""

GRADIENT_NORM = 5.0
"""Maximum norm of a member's gradient, because rows in a flow's tail can have very large
losses."""


@dataclass(frozen=True)
class TrainingOptions:
    """How to train.

    Attributes:
        shares_held_out: Whether all members hold out the same rows; otherwise each holds out its
            own.
        epochs: Maximum number of passes through the data.
        batch_size: Maximum number of rows of a mini-batch; fewer with few rows, see
            :data:`MIN_BATCHES`.
        learning_rate: Peak of the one-cycle schedule (Smith & Topin 2019).
        weight_decay: Decoupled weight decay (Loshchilov & Hutter 2019).
        averaging: Decay of the running average of the weights. The average is validated and kept;
            with 0 the last weights are kept instead.
        validation_fraction: Fraction of the rows held out.
        patience: Number of epochs without improvement after which training stops. While the best
            epoch is an early one, the number is smaller, but at least :data:`MIN_PATIENCE`. This
            saves time where nothing is left to learn after preconditioning.
    """

    shares_held_out: ClassVar[bool] = False

    epochs: int = 30
    batch_size: int = 512
    learning_rate: float = 1e-2
    weight_decay: float = 0.0
    averaging: float = 0.99
    validation_fraction: float = 0.1
    patience: int = 20


@dataclass(frozen=True)
class Fit:
    """A trained ensemble.

    Attributes:
        weights: Parameters and buffers by name, each ``(members, ...)``.
        validation: Best mean validation objective of every member, ``(members,)``.
        best_epochs: Epoch in which it was reached, ``(members,)``; 0 is before the first step.
        epochs: Number of epochs trained.
        held_out: Indices of the rows that each member held out, ``(members, n)``.
    """

    weights: dict[str, Tensor]
    validation: Tensor
    best_epochs: Tensor
    epochs: int
    held_out: Tensor


MIN_BATCHES, MIN_BATCH_SIZE = 16, 32
"""An epoch has at least 16 steps, unless batches would become smaller than 32 rows. With 2000
simulations of slcp this increases the held-out log density by 0.5 nats compared with batches of
512."""

MIN_PATIENCE = 3
"""Minimum number of epochs; nonlinear problems improve in the first one."""

VALIDATION_CHUNK = 4096
"""Number of held-out rows evaluated in one batch."""

WARM_UP = 0.2
"""Fraction of the steps in which the learning rate rises."""

START_RATE, END_RATE = 0.1, 0.01
"""Learning rate of the first and of the last step, relative to the peak."""


def one_cycle(fraction: float) -> float:
    """Returns the learning rate relative to its peak after a fraction of all steps.

    Half a cosine up and half a cosine down (Smith & Topin 2019).
    """
    if fraction < WARM_UP:
        edge, position = START_RATE, 1 - fraction / WARM_UP
    else:
        edge, position = END_RATE, (fraction - WARM_UP) / (1 - WARM_UP)
    return edge + (1 - edge) * 0.5 * (1 + math.cos(math.pi * position))


def train(
    networks: Sequence[nn.Module],
    loss: Loss,
    num_rows: int,
    options: TrainingOptions,
    device: torch.device,
    evaluator: Evaluator | None = None,
    progress: Callable[[float, str], None] | None = None,
    validation_loss: Loss | None = None,
) -> Fit:
    """Trains an ensemble; every member has its own mini-batches.

    Draws from torch's global stream on the CPU, for any device.

    Args:
        networks: Untrained members of equal structure; each maps (u, f) to log densities.
        loss: The objective.
        num_rows: Rows of the data.
        options: How to train.
        device: Where the data are.
        evaluator: Joint evaluation of all members; :func:`vectorised` if ``None``.
        progress: Called after every epoch with the fraction done and a short status.
        validation_loss: The objective at held-out rows if it differs from ``loss``. It selects the
            best epoch and must not be random.
    """
    members = len(networks)
    networks = [network.to(device).train() for network in networks]
    parameters, buffers = stack_module_state(list(networks))
    evaluate = (evaluator or vectorised)(networks[0], parameters, buffers)
    weights = [w for w in parameters.values()]
    optimizer = torch.optim.AdamW(
        weights,
        lr=options.learning_rate,
        betas=(0.9, 0.99),
        weight_decay=options.weight_decay,
        fused=True,
    )
    average = [w.detach().clone() for w in weights]
    best = [w.detach().clone() for w in weights]
    best_value = torch.full((members,), -math.inf, device=device)
    best_epochs = torch.zeros(members, dtype=torch.long, device=device)

    orders = [torch.randperm(num_rows) for _ in range(1 if options.shares_held_out else members)]
    rows = torch.stack(orders).expand(members, -1).to(device)
    num_held_out = max(1, round(options.validation_fraction * num_rows))
    held_out, rows = rows[:, :num_held_out], rows[:, num_held_out:]
    batch_size = max(MIN_BATCH_SIZE, rows.shape[1] // MIN_BATCHES)
    batch_size = min(batch_size, options.batch_size, rows.shape[1])
    num_batches = rows.shape[1] // batch_size
    num_steps, step, epoch = options.epochs * num_batches, 0, 0
    for epoch in range(options.epochs + 1):
        if epoch:
            shuffle = torch.stack([torch.randperm(rows.shape[1]) for _ in range(members)])
            rows = rows.gather(1, shuffle.to(device))
            for batch in rows[:, : num_batches * batch_size].split(batch_size, dim=1):
                optimizer.param_groups[0]["lr"] = options.learning_rate * one_cycle(
                    step / num_steps
                )
                optimizer.zero_grad()
                loss(evaluate, batch).mean(1).sum().backward()
                _clip_gradients(weights)
                optimizer.step()
                step += 1
                # At first the average decays faster, so that it leaves the initial weights.
                decay = min(options.averaging, (1 + step) / (10 + step))
                with torch.no_grad():
                    for mean, new in zip(average, weights, strict=True):
                        mean.lerp_(new, 1 - decay)
        networks[0].eval()
        value = _validate(evaluate, validation_loss or loss, held_out, weights, average)
        networks[0].train()
        improved = value > best_value
        best_value = torch.where(improved, value, best_value)
        best_epochs = torch.where(improved, epoch, best_epochs)
        for kept, new in zip(best, average, strict=True):
            kept[improved] = new[improved]
        if progress is not None:
            progress(
                epoch / options.epochs,
                f"epoch {epoch}, validation {best_value.mean().item():.3f}",
            )
        last = int(best_epochs.max())
        if epoch - last >= min(options.patience, max(MIN_PATIENCE, last)):
            break
    if not best_value.isfinite().all():
        raise BackendError("Training diverged: the validation objective was never finite.")
    trained = dict(zip(parameters, best, strict=True)) | buffers
    return Fit(
        {k: v.detach() for k, v in trained.items()}, best_value, best_epochs, epoch, held_out
    )


def vectorised(
    network: nn.Module, parameters: dict[str, Tensor], buffers: dict[str, Tensor]
) -> LogProb:
    """Returns the log densities of all members as one call."""

    def single(p: dict[str, Tensor], b: dict[str, Tensor], u: Tensor, f: Tensor) -> Tensor:
        return functional_call(network, (p, b), (u, f))

    stacked = vmap(single, randomness="different")
    return lambda u, f: stacked(parameters, buffers, u, f)


def in_turn(
    network: nn.Module, parameters: dict[str, Tensor], buffers: dict[str, Tensor]
) -> LogProb:
    """Returns the log densities of all members as one call per member."""

    def stacked(u: Tensor, f: Tensor) -> Tensor:
        values = []
        for k in range(len(u)):
            state = {name: w[k] for name, w in (parameters | buffers).items()}
            values.append(functional_call(network, state, (u[k], f[k])))
        return torch.stack(values)

    return stacked


@torch.no_grad()
def _clip_gradients(weights: list[Tensor]) -> None:
    """Limits the norm of each member's gradient; one that is not finite becomes zero."""
    gradients = [w.grad for w in weights if w.grad is not None]
    square = sum((g.flatten(1) ** 2).sum(1) for g in gradients)
    norm = torch.as_tensor(square).sqrt()
    finite = norm.isfinite()
    scale = (GRADIENT_NORM / norm.clamp(min=GRADIENT_NORM)).where(finite, torch.zeros_like(norm))
    for g in gradients:
        shape = (-1,) + (1,) * (g.ndim - 1)
        if not finite.all():
            g.nan_to_num_(0.0, 0.0, 0.0)
        g.mul_(scale.view(shape))


@torch.no_grad()
def _validate(
    evaluate: LogProb,
    loss: Loss,
    rows: Tensor,
    weights: list[Tensor],
    average: list[Tensor],
) -> Tensor:
    """Returns minus the mean loss of each member's held-out rows, ``(members,)``, at `average`."""
    current = [w.detach().clone() for w in weights]
    for w, mean in zip(weights, average, strict=True):
        w.copy_(mean)
    total = torch.zeros(len(rows), device=rows.device)
    for chunk in rows.split(VALIDATION_CHUNK, dim=1):
        total -= loss(evaluate, chunk).sum(1)
    for w, value in zip(weights, current, strict=True):
        w.copy_(value)
    return total / rows.shape[1]
