"""The two denoisers. Frames are float32 on [0,1], one grey channel; sigma is the noise's standard deviation on that
scale.

Both consist of convolution, bias and ReLU without batch norm. A folded batch norm gives the same, so the exported graph
is the trained one.
"""
import torch
import torch.nn as nn
import torch.nn.functional as F


def conv(inputs, outputs, stride=1):
    return nn.Conv2d(inputs, outputs, 3, stride, 1)


class ConvByFrame(nn.Conv2d):
    """One convolution for each of three frames with its noise map: weights [3n,2,3,3]."""

    def __init__(self, outputs):
        super().__init__(6, outputs, 3, 1, 1, groups=3)

    def dense(self):
        """The weights [3n,4,3,3] of an equivalent single convolution of the three frames and their common noise map.

        This costs 1 % more arithmetic, but runtimes have faster kernels for it (not measured on a GPU).
        """
        frames, noise = self.weight.split(1, 1)
        return torch.cat([torch.cat([F.pad(w, (0, 0, 0, 0, k, 2 - k)) for k, w in enumerate(frames.chunk(3))]), noise], 1)

    def forward(self, x):
        """x [N,6,H,W]: each frame is followed by the noise map."""
        return F.conv2d(x[:, [0, 2, 4, 1]], self.dense(), self.bias, padding=1) if x.is_cuda else super().forward(x)


def start_from_identity(net, last):
    """He initialisation with a last layer of zeros, so that a residual network starts as the identity."""
    for m in net.modules():
        if isinstance(m, nn.Conv2d):
            nn.init.kaiming_normal_(m.weight, nonlinearity='relu')
            nn.init.zeros_(m.bias)
    nn.init.zeros_(last.weight)


class Block(nn.Module):
    """Three frames and a noise map -> the middle frame, denoised (a 3-frame U-Net with 32, 64 and 128 channels).

    Tassano, Delon and Veit, "FastDVDnet", CVPR 2020. Height and width must be multiples of 4.
    """

    def __init__(self, widths=(32, 64, 128), per_frame=30):
        super().__init__()
        a, b, c = widths
        relu = lambda: nn.ReLU(inplace=True)
        self.inc = nn.Sequential(ConvByFrame(3 * per_frame), relu(), conv(3 * per_frame, a), relu())
        self.d0 = nn.Sequential(conv(a, b, 2), relu(), conv(b, b), relu(), conv(b, b), relu())
        self.d1 = nn.Sequential(conv(b, c, 2), relu(), conv(c, c), relu(), conv(c, c), relu())
        self.u2 = nn.Sequential(conv(c, c), relu(), conv(c, c), relu(), conv(c, b * 4), nn.PixelShuffle(2))
        self.u1 = nn.Sequential(conv(b, b), relu(), conv(b, b), relu(), conv(b, a * 4), nn.PixelShuffle(2))
        self.out = nn.Sequential(conv(a, a), relu(), conv(a, 1))
        start_from_identity(self, self.out[-1])

    def forward(self, f0, f1, f2, noise):
        """All [N,1,H,W] -> [N,1,H,W]."""
        x0 = self.inc(torch.cat((f0, noise, f1, noise, f2, noise), 1))
        x1 = self.d0(x0)
        x1 = x1 + self.u2(self.d1(x1))
        return f1 - self.out(x0 + self.u1(x1))


class FastDVDnet(nn.Module):
    """Five frames -> the middle one, in two stages: the first denoises three triplets, the second the triplet of their
    results."""

    def __init__(self):
        super().__init__()
        self.t1 = Block()
        self.t2 = Block()

    def forward(self, x, sigma):
        """x [N,5,H,W], sigma [N,1,1,1] -> the middle frames [N,1,H,W]."""
        noise = sigma.expand(len(x), 1, *x.shape[2:])
        f = x.split(1, 1)
        y = self.t1(torch.cat(f[0:3]), torch.cat(f[1:4]), torch.cat(f[2:5]), noise.repeat(3, 1, 1, 1))
        return self.t2(*y.chunk(3), noise)

    def clips(self, x, sigma):
        """Whole clips x [N,B,H,W] with B >= 3 and sigma [N,1,1,1] -> [N,B,H,W].

        Time is reflected at the ends. Each triplet's first stage serves three outputs, so a frame costs two blocks instead of four.
        """
        n, b = x.shape[:2]
        padded = x[:, [2, 1, *range(b), b - 2, b - 3]]
        y = triplets(self.t1, padded, sigma)
        return triplets(self.t2, y, sigma)


def triplets(block, x, sigma):
    """One block over all triplets of x [N,B+2,H,W] -> [N,B,H,W]."""
    n, b = x.shape[0], x.shape[1] - 2
    fold = lambda f: f.reshape(n * b, 1, *x.shape[2:])
    noise = sigma.expand(n, b, *x.shape[2:])
    return block(fold(x[:, :-2]), fold(x[:, 1:-1]), fold(x[:, 2:]), fold(noise)).view(n, b, *x.shape[2:])


class FFDNet(nn.Module):
    """One frame at half resolution (four sub-images) and the noise level -> the denoised frame.

    Zhang, Zuo and Zhang, "FFDNet", TIP 2018: 15 layers of 64 channels. Height and width must be even.
    """

    def __init__(self, width=64, depth=15):
        super().__init__()
        layers = [conv(5, width), nn.ReLU(inplace=True)]
        for _ in range(depth - 2):
            layers += [conv(width, width), nn.ReLU(inplace=True)]
        self.body = nn.Sequential(*layers, conv(width, 4))
        start_from_identity(self, self.body[-1])

    def forward(self, x, sigma):
        """x [N,1,H,W], sigma [N,1,1,1] -> [N,1,H,W]."""
        half = F.pixel_unshuffle(x, 2)
        noise = sigma.expand(len(x), 1, *half.shape[2:])
        return x - F.pixel_shuffle(self.body(torch.cat((half, noise), 1)), 2)

    def clips(self, x, sigma):
        """x [N,B,H,W], sigma [N,1,1,1] -> [N,B,H,W], frame by frame."""
        n, b = x.shape[:2]
        y = self(x.reshape(n * b, 1, *x.shape[2:]), sigma.expand(n, b, 1, 1).reshape(n * b, 1, 1, 1))
        return y.view_as(x)


KINDS = {'fastdvdnet': FastDVDnet, 'block': Block, 'ffdnet': FFDNet}


def load(path):
    """A model from a file of weights or a training checkpoint (its averaged weights); the names of the weights identify
    the model."""
    state = torch.load(path, map_location='cpu', weights_only=True)
    state = state.get('average', state)
    kind = 'ffdnet' if 'body.0.weight' in state else 'block' if 'inc.0.weight' in state else 'fastdvdnet'
    net = KINDS[kind]()
    net.load_state_dict(state)
    return net.eval()
