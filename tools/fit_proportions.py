# SPDX-License-Identifier: Apache-2.0
"""Make `body.npz`: the standard human proportions, from skins; `fit_flesh.py` makes the figure's flesh of it.

The paper asks for "the standard human body proportions" (section 2.2, constraint 1). They are taken from a
population of 400 bodies of the parametric body model Anny (CC0 data), children of 1.1 m to adults of 2.0 m, thin to
heavy: the mean of every length and radius, and the ten directions in which people differ most. Needs torch (CPU is
enough, a few minutes) and two files made with `anny` (formats in tools/README.md):

    python tools/fit_proportions.py population.npz posed.npz body.npz
"""

from __future__ import annotations

import argparse
import importlib.util
from pathlib import Path

import numpy as np
import torch

MODES = 10
CONVERT = np.array(
    [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
)  # columns: our forward, left, up in Anny's axes

spec = importlib.util.spec_from_file_location(
    "topology", Path(__file__).parent.parent / "limbloc_ros" / "core" / "_figure_topology.py"
)
assert spec is not None and spec.loader is not None
topology = importlib.util.module_from_spec(spec)
spec.loader.exec_module(topology)
BONES, SPHERES, PARTS = topology.BONES, topology.SPHERES, topology.PARTS
BONE = {name: i for i, (name, *_rest) in enumerate(BONES)}
PARENT = [BONE[b[1]] if b[1] else -1 for b in BONES]

# which of Anny's bones turns ours, and where ours begins: a bone head or a joint
TURNED_BY = {
    "pelvis": "root", "abdomen": "spine05", "thorax": "spine03", "chest": "spine01", "head": "head",
    "clavicle": "clavicle", "upper_arm": "upperarm02", "forearm": "lowerarm01", "hand": "wrist",
    "thigh": "upperleg02", "shin": "lowerleg01", "foot": "foot",
}  # fmt: skip
BEGINS_AT = {
    "pelvis": "root", "abdomen": "spine05", "thorax": "spine03", "chest": "spine01", "head": "neck01",
    "clavicle": "clavicle", "upper_arm": "upperarm01", "forearm": "lowerarm01", "hand": "wrist",
    "thigh": "upperleg01", "shin": "lowerleg01", "foot": "foot",
}  # fmt: skip


def anny_name(table: dict[str, str], bone: str) -> str:
    base, _, side = bone.rpartition("_") if bone[-2:] in ("_L", "_R") else (bone, "", "")
    return table[base] + (f".{side}" if side else "")


def unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def frame_from_z(z: np.ndarray, y_hint: np.ndarray) -> np.ndarray:
    """[N, 3, 3] rotations whose columns are x, y, z with z given and y as near as possible to the hint."""
    y = unit(y_hint - (y_hint * z).sum(-1, keepdims=True) * z)
    return np.stack([np.cross(y, z), y, z], axis=-1)


def rest_frames(heads: dict[str, np.ndarray], hinge: np.ndarray) -> dict[str, np.ndarray]:
    """T_anny_bone rotations [N, 3, 3] of our bones in Anny's rest pose (an A pose)."""
    n = len(heads["root"])
    out = {}
    for name, *_ in BONES:
        out[name] = np.broadcast_to(CONVERT, (n, 3, 3))
    for side, sign in (("L", 1.0), ("R", -1.0)):
        shoulder, elbow, wrist = (heads[f"{b}.{side}"] for b in ("upperarm01", "lowerarm01", "wrist"))
        flexion_axis = hinge * np.array([1.0, sign, sign])  # mirror image of an axial vector
        out[f"upper_arm_{side}"] = frame_from_z(unit(shoulder - elbow), np.broadcast_to(-flexion_axis, (n, 3)))
        out[f"forearm_{side}"] = frame_from_z(unit(elbow - wrist), np.broadcast_to(-flexion_axis, (n, 3)))
        out[f"hand_{side}"] = out[f"forearm_{side}"]
        hip, knee, ankle = (heads[f"{b}.{side}"] for b in ("upperleg01", "lowerleg01", "foot"))
        left = np.broadcast_to(np.array([1.0, 0.0, 0.0]), (n, 3))
        out[f"thigh_{side}"] = frame_from_z(unit(hip - knee), left)
        out[f"shin_{side}"] = frame_from_z(unit(knee - ankle), left)
    return out


def symmetrised(value: np.ndarray, names: list[str]) -> np.ndarray:
    """Mean of each point [N, M, 3] with the mirror image (y) of its other side."""
    out = value.copy()
    for i, name in enumerate(names):
        other = name[:-1] + {"L": "R", "R": "L"}[name[-1]] if name[-2:] in ("_L", "_R") else name
        out[:, i] = 0.5 * (value[:, i] + value[:, names.index(other)] * np.array([1.0, -1.0, 1.0]))
    return out


def part_weights(p: torch.Tensor, c: torch.Tensor, r: torch.Tensor) -> torch.Tensor:
    """Barycentric weights [..., Q, P, 3] of the nearest sphere of each part; see `_part_kernels.distance_to_part`."""
    a, b, d = c.unbind(-2)
    ra, rb, rd = r.unbind(-1)
    options = []

    def edge(x: torch.Tensor, rx: torch.Tensor, y: torch.Tensor, ry: torch.Tensor, i: int, j: int) -> None:
        u, q = (y - x).unsqueeze(-3), p.unsqueeze(-2) - x.unsqueeze(-3)
        length = u.norm(dim=-1).clamp_min(1e-6)
        along = (q * u).sum(-1) / length
        off = (q.square().sum(-1) - along.square()).clamp_min(0).sqrt()
        g = ((ry - rx).unsqueeze(-2) / length).clamp(-0.99, 0.99)
        t = ((along + off * g / (1 - g * g).sqrt()) / length).clamp(0, 1)
        w = torch.zeros(*t.shape, 3, dtype=t.dtype)
        w[..., i], w[..., j] = 1 - t, t
        options.append(w)

    edge(a, ra, b, rb, 0, 1)
    edge(b, rb, d, rd, 1, 2)
    edge(a, ra, d, rd, 0, 2)
    u, v = (b - a).unsqueeze(-3), (d - a).unsqueeze(-3)
    q = p.unsqueeze(-2) - a.unsqueeze(-3)
    uu, uv, vv = (u * u).sum(-1), (u * v).sum(-1), (v * v).sum(-1)
    det = (uu * vv - uv * uv).clamp_min(1e-12)
    qu, qv = (q * u).sum(-1), (q * v).sum(-1)
    s, t = (vv * qu - uv * qv) / det, (uu * qv - uv * qu) / det
    h = (q - s.unsqueeze(-1) * u - t.unsqueeze(-1) * v).norm(dim=-1)
    rb_, rd_ = (rb - ra).unsqueeze(-2), (rd - ra).unsqueeze(-2)
    gs, gt = (vv * rb_ - uv * rd_) / det, (uu * rd_ - uv * rb_) / det
    g2 = (gs * rb_ + gt * rd_).clamp(0, 0.99)
    s, t = s + h / (1 - g2).sqrt() * gs, t + h / (1 - g2).sqrt() * gt
    inner = (s >= 0) & (t >= 0) & (s + t <= 1) & (det > 1e-10)
    w = torch.stack([1 - s - t, s, t], -1)
    options.append(torch.where(inner.unsqueeze(-1), w, options[0]))
    stack = torch.stack(options)
    centre = torch.einsum("o...qpk,...pki->o...qpi", stack, c)
    distance = (p.unsqueeze(-2) - centre).norm(dim=-1) - torch.einsum("o...qpk,...pk->o...qp", stack, r)
    best = distance.argmin(0)
    return stack.gather(0, best.unsqueeze(0).unsqueeze(-1).expand(1, *stack.shape[1:]))[0]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("population")
    parser.add_argument("posed")
    parser.add_argument("out")
    parser.add_argument("--steps", type=int, default=400)
    args = parser.parse_args()
    torch.set_num_threads(1)
    rng = np.random.default_rng(0)
    pop, posed = (np.load(path, allow_pickle=False) for path in (args.population, args.posed))
    stature = pop["stature"].astype(float)
    names = [str(n) for n in pop["bone_names"]]
    heads = {n: pop["bone_heads"][:, i].astype(float) for i, n in enumerate(names)}

    # The elbow's hinge axis in Anny's rest axes (left arm): principal direction of the forearm's relative rotation.
    rot = posed["bone_rotations"].astype(float)
    rel = np.einsum("fji,fjk->fik", rot[:, names.index("upperarm02.L")], rot[:, names.index("lowerarm01.L")])
    rotvec = np.stack([rel[:, 2, 1] - rel[:, 1, 2], rel[:, 0, 2] - rel[:, 2, 0], rel[:, 1, 0] - rel[:, 0, 1]], -1)
    hinge = np.linalg.svd(rotvec)[2][0]
    arm = unit(heads["wrist.L"] - heads["lowerarm01.L"]).mean(0)
    hinge = hinge if np.cross(hinge, arm)[1] < 0 else -hinge  # flexion takes the hand forward (Anny: -y)
    print("elbow hinge (left, rest axes)", hinge.round(3))

    # Skeleton of every person, normalised by stature, in our bones' axes.
    frames = rest_frames(heads, hinge)
    origin = {b[0]: heads[anny_name(BEGINS_AT, b[0])] for b in BONES}
    origin["pelvis"] = pop["joints"][:, [str(n) for n in pop["joint_names"]].index("pelvis_centre")].astype(float)
    bone_names = [b[0] for b in BONES]
    offsets = np.zeros((len(stature), len(BONES), 3))
    for i, b in enumerate(bone_names):
        if PARENT[i] >= 0:
            p = bone_names[PARENT[i]]
            offsets[:, i] = np.einsum("nji,nj->ni", frames[p], origin[b] - origin[p])
    joint_names = [str(n) for n in pop["joint_names"]]
    joints = pop["joints"].astype(float).copy()
    for k, side in enumerate("LR"):
        joints[:, joint_names.index(f"fingertip_{side}")] = pop["fingertip_curled"][:, k]
    ours = list(topology.JOINT_BONES)
    joint_offsets = np.zeros((len(stature), len(ours), 3))
    for i, j in enumerate(ours):
        b = topology.JOINT_BONES[j]
        joint_offsets[:, i] = np.einsum("nji,nj->ni", frames[b], joints[:, joint_names.index(j)] - origin[b])
    offsets = symmetrised(offsets, bone_names) / stature[:, None, None]
    joint_offsets = symmetrised(joint_offsets, ours) / stature[:, None, None]

    # Girths: how thick the body is around our bones, to find the modes together with the lengths.
    part_names, vertex_part = [str(n) for n in pop["part_names"]], pop["vertex_part"]
    verts = pop["vertices"].astype(np.float64)
    girth = []
    for k, part in enumerate(part_names):
        if part.endswith("_R"):
            continue
        v = verts[:, vertex_part == k]
        v = v - v.mean(1, keepdims=True)
        cov = np.einsum("nvi,nvj->nij", v, v) / v.shape[1]
        girth.append(np.sqrt(np.linalg.eigvalsh(cov)) / stature[:, None])
    features = np.concatenate(
        [offsets.reshape(len(stature), -1), joint_offsets.reshape(len(stature), -1), 2 * np.concatenate(girth, 1)], 1
    )
    mean = features.mean(0)
    U, S, _ = np.linalg.svd(features - mean, full_matrices=False)
    beta = U[:, :MODES] * np.sqrt(len(stature))
    print("explained", (np.cumsum(S**2) / (S**2).sum())[: MODES + 4].round(4))
    design = np.concatenate([np.ones((len(stature), 1)), beta], 1)

    def linear(values: np.ndarray) -> np.ndarray:
        """Least squares [..., 1 + MODES] of values [N, ...] over mean and modes."""
        flat = values.reshape(len(stature), -1)
        solved, *_ = np.linalg.lstsq(design, flat, rcond=None)
        return solved.T.reshape(*values.shape[1:], 1 + MODES)

    bone_table, joint_table = linear(offsets), linear(joint_offsets)
    residual = joint_offsets - np.einsum("jik,nk->nji", joint_table, design)
    print("joint offsets left unexplained, mm at 1.75 m:", (np.abs(residual).mean((0, 2)) * 1750).round(1))

    # Spheres: centre and radius linear in the modes, learnt from the skins in rest pose and posed.
    area = np.zeros(verts.shape[1])
    tri = pop["faces"]
    m = verts[0]
    a = 0.5 * np.linalg.norm(np.cross(m[tri[:, 1]] - m[tri[:, 0]], m[tri[:, 2]] - m[tri[:, 0]]), axis=1)
    for k in range(3):
        np.add.at(area, tri[:, k], a / 3)
    area /= area.sum()

    sphere_names = [s[0] for s in SPHERES]
    sphere_bone = np.array([BONE[s[1]] for s in SPHERES])
    independent = [i for i, n in enumerate(sphere_names) if not n.endswith("_R")]
    mirror = [sphere_names.index(n[:-2] + "_L") if n.endswith("_R") else i for i, n in enumerate(sphere_names)]
    flip = torch.tensor([[1.0, -1.0 if n.endswith("_R") else 1.0, 1.0] for n in sphere_names])
    middle = torch.tensor([[1.0, 1.0 if n.endswith(("_L", "_R")) else 0.0, 1.0] for n in sphere_names])
    lookup = torch.tensor([independent.index(i) for i in mirror])
    centre0 = np.zeros((len(independent), 3, 1 + MODES))
    radius0 = np.zeros((len(independent), 1 + MODES))
    for row, i in enumerate(independent):
        _, _, at, radius, *end = SPHERES[i]
        centre0[row, :, 0] = np.array(at) / 1.75
        radius0[row, 0] = radius / 1.75
        if end:  # given as a fraction of the way to a child bone's origin
            child, fraction = end
            centre0[row] += fraction * bone_table[BONE[child]]
    centre = torch.tensor(centre0, dtype=torch.float32, requires_grad=True)
    log_radius = torch.tensor(np.log(radius0[:, 0]), dtype=torch.float32, requires_grad=True)
    radius_modes = torch.tensor(radius0[:, 1:], dtype=torch.float32, requires_grad=True)
    anchor_centre = centre.detach().clone()
    # small spheres would wander along the fingers: they stay near where the hand's joints put them
    held = torch.tensor([200.0 if SPHERES[i][1].startswith("hand") else 1.0 for i in independent])
    parts = torch.tensor([[sphere_names.index(p[min(k, len(p) - 1)]) for k in range(3)] for _, p in PARTS])

    def posed_frames(which: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """World rotations [M, B, 3, 3] and origins [M, B, 3] of our bones in posed meshes."""
        person = posed["person"][which]
        world = np.zeros((len(which), len(BONES), 3, 3))
        place = np.zeros((len(which), len(BONES), 3))
        jn = joint_names
        for i, b in enumerate(bone_names):
            world[:, i] = rot[which, names.index(anny_name(TURNED_BY, b))] @ frames[b][person]
            if PARENT[i] < 0:
                place[:, i] = posed["joints"][which, jn.index("pelvis_centre")]
            else:
                o = offsets[person, i] * stature[person, None]
                place[:, i] = place[:, PARENT[i]] + np.einsum("mij,mj->mi", world[:, PARENT[i]], o)
        return world, place

    rest_world = np.stack([frames[b] for b in bone_names], 1)
    rest_place = np.stack([origin[b] for b in bone_names], 1)
    B = torch.tensor(design, dtype=torch.float32)
    optimiser = torch.optim.Adam(
        [{"params": [centre], "lr": 6e-4}, {"params": [log_radius], "lr": 8e-3}, {"params": [radius_modes], "lr": 2e-4}]
    )
    for step in range(args.steps):
        lr_scale = 1.0 if step < 0.6 * args.steps else 0.25
        for group, lr in zip(optimiser.param_groups, (6e-4, 8e-3, 2e-4), strict=True):
            group["lr"] = lr * lr_scale
        if step % 2:
            which = rng.choice(len(posed["person"]), 16, replace=False)
            person = posed["person"][which]
            world, place = posed_frames(which)
            skin = posed["vertices"][which]
        else:
            person = rng.choice(len(stature), 16, replace=False)
            world, place, skin = rest_world[person], rest_place[person], verts[person]
        pick = rng.choice(len(area), 700, p=area)
        p = torch.tensor(skin[:, pick], dtype=torch.float32)
        H = torch.tensor(stature[person], dtype=torch.float32)
        local = torch.einsum("sik,nk->nsi", centre[lookup] * flip[:, :, None] * middle[:, :, None], B[person])
        r = (log_radius.exp()[lookup] + torch.einsum("sk,nk->ns", radius_modes[lookup], B[person][:, 1:])).clamp_min(
            0.003
        )
        W = torch.tensor(world[:, sphere_bone], dtype=torch.float32)
        O = torch.tensor(place[:, sphere_bone], dtype=torch.float32)
        c = O + torch.einsum("nsij,nsj->nsi", W, local) * H[:, None, None]
        r = r * H[:, None]
        with torch.no_grad():
            w = part_weights(p, c[:, parts], r[:, parts])
        d = (p.unsqueeze(-2) - torch.einsum("nqpk,npki->nqpi", w, c[:, parts])).norm(dim=-1) - torch.einsum(
            "nqpk,npk->nqp", w, r[:, parts]
        )
        d = d.min(-1).values
        surface = torch.nn.functional.huber_loss(d, torch.zeros_like(d), delta=0.015) / 0.015
        poke = (r - torch.cdist(c, p).min(-1).values).clamp_min(0).mean()
        drift = (
            ((centre - anchor_centre)[:, :, 0].square() * held[:, None]).mean() * 3
            + centre[:, :, 1:].square().mean() * 20
            + radius_modes.square().mean() * 20
        )
        loss = surface + 0.5 * poke + drift
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        if step % 50 < 2 or step == args.steps - 1:
            print(
                f"{step:4d} mean |distance| {1000 * d.abs().mean().item():.1f} mm,"
                f" signed {1000 * d.mean().item():+.1f},"
                f" poking out {1000 * poke.item():.1f}",
                flush=True,
            )

    with torch.no_grad():
        centre_table = (centre[lookup] * flip[:, :, None] * middle[:, :, None]).numpy()
        radius_table = torch.cat([log_radius.exp()[:, None], radius_modes], 1)[lookup].numpy()
    for i, n in enumerate(sphere_names):
        if not n.endswith("_R"):
            print(n, (1750 * centre_table[i, :, 0]).round(0), (1750 * radius_table[i, 0]).round(0))
    np.savez_compressed(
        args.out,
        bone_names=np.array(bone_names), bone_offsets=bone_table.astype(np.float32),
        joint_names=np.array(ours), joint_offsets=joint_table.astype(np.float32),
        sphere_names=np.array(sphere_names), sphere_centres=centre_table.astype(np.float32),
        sphere_radii=radius_table.astype(np.float32),
        log_stature=np.array([np.log(stature).mean(), np.log(stature).std()], np.float32),
    )  # fmt: skip


if __name__ == "__main__":
    main()
