// The robot's forward kinematics and nearest points, without a scene.
import { Matrix4, Vector3 } from "three";

// Placements T[k] that k turned axes give to what they move, from the pose at zero: the product of exponentials.
export function placements(screws, q) {
  const found = [new Matrix4()];
  for (let k = 0; k < screws.length; k++) {
    const [vx, vy, vz, wx, wy, wz] = screws[k];
    const axis = new Vector3(wx, wy, wz);
    const turn = new Matrix4().makeRotationAxis(axis, q[k]);
    const foot = axis.clone().cross(new Vector3(vx, vy, vz)); // the axis' point nearest to the world's origin
    const shift = foot.clone().sub(foot.clone().applyMatrix4(turn));
    found.push(found[k].clone().multiply(turn.setPosition(shift)));
  }
  return found;
}

// Ends [[a, b], ...] of the links' axes, and the TCP.
export function posed(robot, q) {
  const T = placements(robot.screws, q);
  const ends = robot.ends_m.map((pair, i) => pair.map((end) => new Vector3(...end).applyMatrix4(T[robot.moved_by[i]])));
  return { T, ends, tcp: new Vector3(...robot.tcp_m).applyMatrix4(T[T.length - 1]) };
}

// Nearest points of two segments (a, b) and (c, d).
export function nearestOfSegments(a, b, c, d) {
  const u = b.clone().sub(a), v = d.clone().sub(c), w = a.clone().sub(c);
  const uu = u.dot(u), uv = u.dot(v), vv = v.dot(v), uw = u.dot(w), vw = v.dot(w);
  const denominator = uu * vv - uv * uv;
  const clamp = (x) => Math.max(0, Math.min(1, x));
  let s = denominator > 1e-12 ? clamp((uv * vw - vv * uw) / denominator) : 0;
  let t = vv > 1e-12 ? clamp((uv * s + vw) / vv) : 0;
  s = uu > 1e-12 ? clamp((uv * t - uw) / uu) : 0;
  return [a.clone().addScaledVector(u, s), c.clone().addScaledVector(v, t)];
}

// Nearest points of a segment (a, b) and the hull of vertices, by conditional gradients with pairwise steps.
export function nearestToHull(a, b, vertices) {
  const count = vertices.length / 3;
  const corner = (k, out) => out.set(vertices[3 * k], vertices[3 * k + 1], vertices[3 * k + 2]);
  const weight = new Map([[0, 1]]);
  const q = corner(0, new Vector3()), p = a.clone(), ab = b.clone().sub(a), away = new Vector3(), edge = new Vector3();
  const here = new Vector3(), there = new Vector3();
  const length2 = Math.max(ab.dot(ab), 1e-12);
  for (let round = 0; round < 300; round++) {
    p.copy(a).addScaledVector(ab, Math.max(0, Math.min(1, away.copy(q).sub(a).dot(ab) / length2)));
    away.copy(p).sub(q);
    let best = 0, top = -Infinity, worst = 0, low = Infinity;
    for (let k = 0; k < count; k++) {
      const along = vertices[3 * k] * away.x + vertices[3 * k + 1] * away.y + vertices[3 * k + 2] * away.z;
      if (along > top) [best, top] = [k, along];
      if (along < low && weight.has(k)) [worst, low] = [k, along];
    }
    if (top - q.dot(away) < 1e-7) break;
    edge.copy(corner(best, there)).sub(corner(worst, here));
    const step = Math.min(weight.get(worst), edge.dot(away) / Math.max(edge.dot(edge), 1e-12));
    weight.set(best, (weight.get(best) ?? 0) + step);
    if (weight.get(worst) - step <= 1e-12) weight.delete(worst);
    else weight.set(worst, weight.get(worst) - step);
    q.addScaledVector(edge, step);
  }
  return [p, q];
}

// Surface points that face each other, from the points on the axes and the radii.
export function surfaces(p, q, rp, rq) {
  const apart = q.clone().sub(p);
  const length = apart.length();
  if (length > 0) apart.divideScalar(length);
  return { from: p.clone().addScaledVector(apart, rp), to: q.clone().addScaledVector(apart, -rq), distance: length - rp - rq };
}
