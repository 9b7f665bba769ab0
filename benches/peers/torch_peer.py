"""PyTorch, eager, in channels-last memory where it is faster. Prints one JSON object.

    python torch_peer.py --network hyper --task train|infer|latency
"""

import torch
from common import OUTPUTS, arguments, latency, random_batches, report, throughput
from torch import nn


class PositionPReLU(nn.Module):
    """PReLU with one slope for each position and channel, as Keras has it."""

    def __init__(self, *shape):
        super().__init__()
        self.slope = nn.Parameter(torch.zeros(shape))

    def forward(self, x):
        return torch.where(x > 0, x, self.slope * x)


def hyper():
    def conv(before, after, activation, pool=True):
        parts = [nn.Conv2d(before, after, 3), nn.BatchNorm2d(after, eps=1e-3, momentum=0.01), activation]
        return [*parts, nn.MaxPool2d(2)] if pool else parts

    return nn.Sequential(
        *conv(3, 8, nn.ReLU(), pool=False),
        *conv(8, 16, nn.ReLU()),
        *conv(16, 24, PositionPReLU(24, 16, 76)),
        *conv(24, 32, PositionPReLU(32, 6, 36)),
        *conv(32, 64, PositionPReLU(64, 1, 16), pool=False),
        nn.Flatten(),
        nn.Linear(1024, 100), nn.BatchNorm1d(100, eps=1e-3, momentum=0.01), nn.Dropout(0.5), PositionPReLU(100),
        nn.Linear(100, 50), PositionPReLU(50), nn.Dropout(0.5),
        nn.Linear(50, 1),
    )  # fmt: skip


def lenet():
    return nn.Sequential(
        nn.Conv2d(1, 6, 3), nn.ELU(), nn.MaxPool2d(4),
        nn.Conv2d(6, 16, 3), nn.ELU(), nn.MaxPool2d(4), nn.Flatten(),
        nn.Linear(144, 120), nn.ELU(), nn.Linear(120, 84), nn.ELU(), nn.Linear(84, 1),
    )  # fmt: skip


def pilotnet():
    return nn.Sequential(
        nn.Conv2d(3, 24, 5, 2), nn.ELU(), nn.Conv2d(24, 36, 5, 2), nn.ELU(), nn.Conv2d(36, 48, 5, 2), nn.ELU(),
        nn.Conv2d(48, 64, 3), nn.ELU(), nn.Conv2d(64, 64, 3), nn.ELU(), nn.Dropout(0.5), nn.Flatten(),
        nn.Linear(1152, 100), nn.ELU(), nn.Linear(100, 50), nn.ELU(), nn.Linear(50, 10), nn.ELU(), nn.Linear(10, 1),
    )  # fmt: skip


def binomial_blur(channels):
    """A fixed blur of 3x3 in each channel."""
    row = torch.tensor([1.0, 2.0, 1.0]) / 4
    blur = nn.Conv2d(channels, channels, 3, padding=1, groups=channels, bias=False)
    blur.weight = nn.Parameter(torch.outer(row, row).expand(channels, 1, 3, 3).clone(), requires_grad=False)
    return blur


def default():
    def conv(before, after, kernel):
        norm = nn.BatchNorm2d(after, eps=1e-3, momentum=0.02)
        return [binomial_blur(before), nn.Conv2d(before, after, kernel, 2), norm, nn.ReLU()]

    return nn.Sequential(
        *conv(3, 16, 5), *conv(16, 24, 3), *conv(24, 32, 3),
        nn.Conv2d(32, 48, 3), nn.ELU(), nn.Flatten(), nn.Dropout(0.1),
        nn.Linear(48 * 16, 64), nn.ELU(), nn.Linear(64, 1),
    )  # fmt: skip


def donkey():
    def conv(before, after, kernel, stride):
        return [nn.Conv2d(before, after, kernel, stride), nn.ReLU(), nn.Dropout(0.2)]

    return nn.Sequential(
        *conv(3, 24, 5, 2), *conv(24, 32, 5, 2), *conv(32, 64, 5, 2), *conv(64, 64, 3, 1), *conv(64, 64, 3, 1),
        nn.Flatten(),
        nn.Linear(64 * 8 * 13, 100), nn.ReLU(), nn.Dropout(0.2), nn.Linear(100, 50), nn.ReLU(), nn.Dropout(0.2),
        nn.Linear(50, OUTPUTS["donkey"]),
    )  # fmt: skip


NETWORKS = {network.__name__: network for network in (hyper, lenet, pilotnet, default, donkey)}


def tensors(args, batch):
    x, y = random_batches(args.network, batch, channels_first=True)
    return [torch.from_numpy(a).to(memory_format=torch.channels_last) for a in x], list(map(torch.from_numpy, y))


def train(model, args):
    optimizer, loss = torch.optim.Adam((p for p in model.parameters() if p.requires_grad), 1e-3, fused=True), nn.MSELoss()
    x, y = tensors(args, args.batch)

    def step(i):
        optimizer.zero_grad(set_to_none=True)
        value = loss(model(x[i % len(x)]), y[i % len(y)])
        value.backward()
        optimizer.step()
        return value.item()

    return throughput(step, args.batch, args.seconds)


def infer(model, args):
    model.eval()
    x, _ = tensors(args, args.batch)
    with torch.inference_mode():
        return throughput(lambda i: model(x[i % len(x)]), args.batch, args.seconds)


def one_image(model, args):
    model.eval()
    x, _ = tensors(args, 1)
    with torch.inference_mode():
        return latency(lambda i: model(x[i % len(x)]), args.seconds)


TASKS = {"train": train, "infer": infer, "latency": one_image}


def main():
    args = arguments(TASKS)
    torch.set_num_threads(args.threads)
    model = NETWORKS[args.network]().to(memory_format=torch.channels_last)
    report(TASKS[args.task](model, args), f"PyTorch {torch.__version__}")


if __name__ == "__main__":
    main()
