#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Score predicted joints. This is the benchmark's own scoring, kept as it came, so that everybody's figures compare.

  python score.py PRED.npz CASE_DIR              one case
  python score.py PRED_DIR SUITE_DIR             PRED_DIR/<case>.npz for every case of the suite (a missing file = all missing)
  options: --joints core|limb13|all  --json OUT.json  --per-case  --per-pose

PRED.npz: joints float [F, J, 3] in metres, world axes of calib.json; joint_names [J] (names of body.JOINTS); NaN = missing.
Missing joints are never dropped: they count MISS_MM in the distance statistics, as a miss in PCK and success,
and 180 degrees in the angle statistics.
"""
import argparse, glob, json, os, sys
import numpy as np

MISS_MM, MISS_DEG = 1000.0, 180.0
SIDES = ("_L", "_R")
LIMB13 = ["head_centre"] + [j + s for j in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle") for s in SIDES]
CORE = LIMB13 + ["neck_base", "torso_centre", "pelvis_centre"] + [j + s for j in ("hand", "toe") for s in SIDES]


def load_pred(fn, F, names):
    out = np.full((F, len(names), 3), np.nan)
    if not os.path.exists(fn):
        return out
    z = np.load(fn, allow_pickle=False); pn = [str(x) for x in z["joint_names"]]; P = z["joints"].astype(float)
    n = min(F, len(P))
    for k, j in enumerate(names):
        if j in pn: out[:n, k] = P[:n, pn.index(j)]
    out[~np.isfinite(out).all(-1)] = np.nan
    return out


def stats(a, unit=""):
    a = np.asarray(a, float).ravel()
    if a.size == 0: return None
    return dict(mean=float(a.mean()), median=float(np.median(a)), p95=float(np.percentile(a, 95)))


def flexion(P, a, b, c):
    u, v = P[b] - P[a], P[c] - P[b]
    return np.degrees(np.arccos(np.clip((u * v).sum(-1) / (np.linalg.norm(u, axis=-1) * np.linalg.norm(v, axis=-1) + 1e-12), -1, 1)))


def direrr(P, Q, a, b):
    u, v = P[b] - P[a], Q[b] - Q[a]
    return np.degrees(np.arccos(np.clip((u * v).sum(-1) / (np.linalg.norm(u, axis=-1) * np.linalg.norm(v, axis=-1) + 1e-12), -1, 1)))


def rigid_align(A, B):
    """Rotation + translation taking A to B (both [J,3])."""
    ca, cb = A.mean(0), B.mean(0); U, _, Vt = np.linalg.svd((A - ca).T @ (B - cb))
    D = np.diag([1, 1, np.sign(np.linalg.det(U @ Vt))])
    return (A - ca) @ (U @ D @ Vt) + cb


def score_case(pred_fn, case):
    gt = np.load(os.path.join(case, "gt.npz")); names = [str(x) for x in gt["joint_names"]]
    G = gt["joints"].astype(float); P = load_pred(pred_fn, len(G), names)
    meta = json.load(open(os.path.join(case, "meta.json")))
    E = np.linalg.norm(P - G, axis=-1) * 1000                          # mm, NaN = missing
    ix = {n: i for i, n in enumerate(names)}
    miss = np.isnan(E); Em = np.where(miss, MISS_MM, E)
    A = {n: P[:, i] for n, i in ix.items()}; B = {n: G[:, i] for n, i in ix.items()}
    ang = {}
    for s in SIDES:
        ang.setdefault("elbow_flexion", []).append(np.abs(flexion(A, "shoulder" + s, "elbow" + s, "wrist" + s) - flexion(B, "shoulder" + s, "elbow" + s, "wrist" + s)))
        ang.setdefault("knee_flexion", []).append(np.abs(flexion(A, "hip" + s, "knee" + s, "ankle" + s) - flexion(B, "hip" + s, "knee" + s, "ankle" + s)))
        ang.setdefault("shoulder_direction", []).append(direrr(A, B, "shoulder" + s, "elbow" + s))
        ang.setdefault("hip_direction", []).append(direrr(A, B, "hip" + s, "knee" + s))
    ang = {k: np.where(np.isnan(v), MISS_DEG, v) for k, v in ((k, np.stack(v, 1)) for k, v in ang.items())}
    swap = {}                                                          # left/right swap: crossed assignment clearly better
    for part, js in (("arms", ("elbow", "wrist")), ("legs", ("knee", "ankle"))):
        d = x = 0
        for j in js:
            l, r = j + "_L", j + "_R"
            d = d + np.linalg.norm(A[l] - B[l], axis=-1) + np.linalg.norm(A[r] - B[r], axis=-1)
            x = x + np.linalg.norm(A[l] - B[r], axis=-1) + np.linalg.norm(A[r] - B[l], axis=-1)
        swap[part] = np.nan_to_num((x < .6 * d) & (d / 4 > .10))
    lim = [ix[j] for j in LIMB13]
    pa = np.full(len(G), np.nan); bias = np.full((len(G), len(names), 3), np.nan)
    for f in range(len(G)):
        k = [i for i in lim if not miss[f, i]]
        if len(k) >= 4: pa[f] = np.linalg.norm(rigid_align(P[f, k], G[f, k]) - G[f, k], axis=1).mean() * 1000
        R = gt["bone_rotations"][f, [str(b) for b in gt["bone_names"]].index("root")].astype(float)
        bias[f] = (P[f] - G[f]) @ R * 1000                             # in pelvis axes (left, back, up)
    acc = None
    if meta["kind"] == "sequence":
        acc = np.linalg.norm(np.diff(P[:, lim], 2, axis=0) - np.diff(G[:, lim], 2, axis=0), axis=-1) * 1000
    return dict(names=names, E=Em, miss=miss, ang=ang, swap=swap, success=(Em[:, lim] < 150).all(1), pa=pa, bias=bias, acc=acc,
                poses=meta["pose_names"] or [meta["sequence"]] * len(G), truncated=gt["truncated"].any(1))


def summarise(rs, joints):
    names = rs[0]["names"]; k = [names.index(j) for j in joints]
    E = np.concatenate([r["E"] for r in rs]); M = np.concatenate([r["miss"] for r in rs])
    b = np.concatenate([r["bias"] for r in rs])
    o = dict(frames=int(len(E)), joints=len(k), missing_percent=float(100 * M[:, k].mean()), mpjpe_mm=stats(E[:, k]),
             pck50=float(100 * (E[:, k] < 50).mean()), pck100=float(100 * (E[:, k] < 100).mean()),
             frame_success_percent=float(100 * np.concatenate([r["success"] for r in rs]).mean()),
             swapped_arms_percent=float(100 * np.concatenate([r["swap"]["arms"] for r in rs]).mean()),
             swapped_legs_percent=float(100 * np.concatenate([r["swap"]["legs"] for r in rs]).mean()),
             rigid_aligned_mpjpe_mm=float(np.nanmean(np.concatenate([r["pa"] for r in rs]))) if not M[:, k].all() else None,
             angles_deg={a: stats(np.concatenate([r["ang"][a] for r in rs])) for a in rs[0]["ang"]},
             per_joint={names[i]: dict(stats(E[:, i]), pck50=float(100 * (E[:, i] < 50).mean()), pck100=float(100 * (E[:, i] < 100).mean()),
                                       bias_left_back_up_mm=[round(float(x), 1) for x in np.nanmedian(b[:, i], 0)] if not M[:, i].all() else None) for i in k})
    acc = [r["acc"][np.isfinite(r["acc"])] for r in rs if r["acc"] is not None]
    if acc and sum(map(len, acc)): o["acceleration_error_mm_per_frame2"] = float(np.concatenate(acc).mean())
    return o


def show(o, title):
    m = o["mpjpe_mm"]
    print(f"== {title}: {o['frames']} frames, {o['joints']} joints, missing {o['missing_percent']:.1f} %")
    print(f"   MPJPE mean {m['mean']:.1f}  median {m['median']:.1f}  p95 {m['p95']:.1f} mm | rigid-aligned {o['rigid_aligned_mpjpe_mm'] or float('nan'):.1f} | PCK50 {o['pck50']:.1f} %  "
          f"PCK100 {o['pck100']:.1f} % | frame success {o['frame_success_percent']:.1f} % | swaps arms {o['swapped_arms_percent']:.1f} legs {o['swapped_legs_percent']:.1f} %"
          + (f" | accel err {o['acceleration_error_mm_per_frame2']:.1f}" if "acceleration_error_mm_per_frame2" in o else ""))
    print("   angles (deg, mean/median/p95): " + "  ".join(f"{k} {v['mean']:.1f}/{v['median']:.1f}/{v['p95']:.1f}" for k, v in o["angles_deg"].items()))


def main():
    ap = argparse.ArgumentParser(); ap.add_argument("pred"); ap.add_argument("gt", nargs="+"); ap.add_argument("--joints", default="core")
    ap.add_argument("--json"); ap.add_argument("--per-case", action="store_true"); ap.add_argument("--per-pose", action="store_true")
    a = ap.parse_args(); todo = []
    for g in a.gt:
        g = g[:-7].rstrip("/") if g.endswith("gt.npz") else g
        if os.path.exists(os.path.join(g, "gt.npz")):
            todo.append((a.pred if a.pred.endswith(".npz") else os.path.join(a.pred, os.path.basename(g.rstrip("/")) + ".npz"), g))
        else:
            todo += [(os.path.join(a.pred, os.path.basename(d) + ".npz"), d) for d in sorted(glob.glob(os.path.join(g, "*"))) if os.path.exists(os.path.join(d, "gt.npz"))]
    rs = {g: score_case(p, g) for p, g in todo}
    names = next(iter(rs.values()))["names"]
    J = dict(core=CORE, limb13=LIMB13, all=names)[a.joints]
    res = dict(overall=summarise(list(rs.values()), J), cases={os.path.basename(g): summarise([r], J) for g, r in rs.items()})
    if a.per_case:
        for g, o in res["cases"].items(): show(o, g)
    if a.per_pose:
        k = [names.index(j) for j in J]; pp = {}
        for r in rs.values():
            for f, n in enumerate(r["poses"]): pp.setdefault(n, []).append((r["E"][f, k].mean(), r["success"][f]))
        res["poses"] = {n: dict(mpjpe_mm=float(np.mean([x[0] for x in v])), success_percent=float(100 * np.mean([x[1] for x in v])), frames=len(v)) for n, v in pp.items()}
        for n, v in sorted(res["poses"].items(), key=lambda t: -t[1]["mpjpe_mm"]): print(f"   {n:24s} {v['mpjpe_mm']:7.1f} mm  success {v['success_percent']:5.1f} %  ({v['frames']})")
    o = res["overall"]
    print(f"   {'joint':14s} {'mean':>7s} {'median':>7s} {'p95':>7s}  PCK50 PCK100  median offset (left, back, up) mm")
    for n, v in o["per_joint"].items(): print(f"   {n:14s} {v['mean']:7.1f} {v['median']:7.1f} {v['p95']:7.1f}  {v['pck50']:5.1f} {v['pck100']:6.1f}  {v['bias_left_back_up_mm']}")
    show(o, "OVERALL")
    if a.json: json.dump(res, open(a.json, "w"), indent=1)


if __name__ == "__main__":
    main()
