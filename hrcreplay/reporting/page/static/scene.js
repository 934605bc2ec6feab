// The 3-D scene: shows one instant of one method.
import * as THREE from "three";
import { OrbitControls } from "three/orbit";
import { between } from "replay/data";
import { nearestOfSegments, nearestToHull, posed, surfaces } from "replay/geometry";

const UP = new THREE.Vector3(0, 0, 1);

// Capsules between two points each.
class Capsules {
  constructor(radii, material) {
    this.radii = radii;
    const ball = new THREE.SphereGeometry(1, 24, 16);
    const rod = new THREE.CylinderGeometry(1, 1, 1, 28, 1, true).rotateX(Math.PI / 2);
    this.group = new THREE.Group();
    this.balls = new THREE.InstancedMesh(ball, material, 2 * radii.length);
    this.rods = new THREE.InstancedMesh(rod, material, radii.length);
    for (const mesh of [this.balls, this.rods]) {
      mesh.frustumCulled = false;
      this.group.add(mesh);
    }
  }

  show(ends) {
    const M = new THREE.Matrix4(), none = new THREE.Matrix4().makeScale(0, 0, 0), turn = new THREE.Quaternion();
    ends.forEach(([a, b], i) => {
      const r = this.radii[i];
      const known = Number.isFinite(a.x + b.x);
      for (const [k, end] of [a, b].entries()) {
        this.balls.setMatrixAt(2 * i + k, known ? M.makeScale(r, r, r).setPosition(end) : none);
      }
      const along = b.clone().sub(a), length = along.length();
      if (known && length > 1e-6) {
        turn.setFromUnitVectors(UP, along.divideScalar(length));
        M.compose(a.clone().add(b).multiplyScalar(0.5), turn, new THREE.Vector3(r, r, length));
      }
      this.rods.setMatrixAt(i, known && length > 1e-6 ? M : none);
    });
    this.balls.instanceMatrix.needsUpdate = this.rods.instanceMatrix.needsUpdate = true;
  }
}

// Surfaces of links, where the turned axes bring them.
class Surfaces {
  constructor(robot, motion, material) {
    this.moved_by = robot.meshes.map((link) => robot.moved_by[link]);
    this.group = new THREE.Group();
    robot.meshes.forEach((_, k) => {
      const geometry = new THREE.BufferGeometry();
      geometry.setAttribute("position", new THREE.BufferAttribute(motion(`mesh/${k}/vertices`).values, 3));
      geometry.setIndex(Array.from(motion(`mesh/${k}/triangles`).values));
      const mesh = new THREE.Mesh(geometry, material);
      mesh.matrixAutoUpdate = mesh.frustumCulled = false;
      this.group.add(mesh);
    });
  }

  show(placements) {
    this.group.children.forEach((mesh, k) => {
      mesh.matrix.copy(placements[this.moved_by[k]]);
      mesh.visible = mesh.matrix.elements.every(Number.isFinite);
      mesh.matrixWorldNeedsUpdate = true;
    });
  }
}

// A line with a width: a rod for each piece that is long enough to be seen.
class Way {
  constructor(most, radius, material) {
    Object.assign(this, { most, radius });
    this.mesh = new THREE.InstancedMesh(new THREE.CylinderGeometry(1, 1, 1, 8, 1, true).rotateX(Math.PI / 2), material, most);
    this.mesh.frustumCulled = false;
  }

  // ``shortest``: pieces up to this length are joined.
  show(points, { pairs = false, shortest = 0 } = {}) {
    const M = new THREE.Matrix4(), turn = new THREE.Quaternion(), along = new THREE.Vector3();
    let count = 0, last = points[0];
    for (let k = 1; k < points.length && count < this.most; k += pairs ? 2 : 1) {
      if (pairs) last = points[k - 1];
      const length = along.copy(points[k]).sub(last).length();
      if (!(length > shortest)) continue;
      turn.setFromUnitVectors(UP, along.divideScalar(length));
      M.compose(points[k].clone().add(last).multiplyScalar(0.5), turn, new THREE.Vector3(this.radius, this.radius, length));
      this.mesh.setMatrixAt(count++, M);
      last = points[k];
    }
    this.mesh.count = count;
    this.mesh.visible = count > 0;
    this.mesh.instanceMatrix.needsUpdate = true;
  }
}

// Directions spread over the unit sphere, and the triangles between them.
function sphere(detail) {
  const soup = new THREE.IcosahedronGeometry(1, detail).getAttribute("position");
  const seen = new Map(), directions = [], triangles = [];
  for (let k = 0; k < soup.count; k++) {
    const d = [soup.getX(k), soup.getY(k), soup.getZ(k)];
    const key = d.map((x) => Math.round(1e4 * x)).join();
    if (!seen.has(key)) {
      seen.set(key, directions.length / 3);
      directions.push(...d);
    }
    triangles.push(seen.get(key));
  }
  return { directions: new Float32Array(directions), triangles };
}

// The surface of hull + ball: for each direction the furthest vertex, and the ball's radius from there.
class Volume {
  constructor(ball, material) {
    this.ball = ball;
    const geometry = new THREE.BufferGeometry();
    geometry.setIndex(ball.triangles);
    geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(ball.directions.length), 3));
    geometry.setAttribute("normal", new THREE.BufferAttribute(ball.directions, 3));
    this.mesh = new THREE.Mesh(geometry, material);
    this.mesh.frustumCulled = false;
  }

  show(vertices, radius) {
    const { directions } = this.ball, attribute = this.mesh.geometry.getAttribute("position"), out = attribute.array;
    for (let d = 0; d < directions.length; d += 3) {
      const x = directions[d], y = directions[d + 1], z = directions[d + 2];
      let best = 0, top = -Infinity;
      for (let v = 0; v < vertices.length; v += 3) {
        const along = vertices[v] * x + vertices[v + 1] * y + vertices[v + 2] * z;
        if (along > top) [best, top] = [v, along];
      }
      out[d] = vertices[best] + radius * x;
      out[d + 1] = vertices[best + 1] + radius * y;
      out[d + 2] = vertices[best + 2] + radius * z;
    }
    attribute.needsUpdate = true;
  }
}

export class ReplayView {
  constructor(canvas, data, colours) {
    this.data = data;
    const { header } = data;
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true });
    this.scene = new THREE.Scene();
    this.camera = new THREE.PerspectiveCamera(38, 1, 0.05, 60);
    this.camera.up.copy(UP);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.addEventListener("change", () => this.render());
    this.scene.add(new THREE.HemisphereLight(0xffffff, 0x8a8f98, 2.2));
    const sun = new THREE.DirectionalLight(0xffffff, 1.6);
    sun.position.set(2, -3, 5);
    this.scene.add(sun);
    const solid = () => new THREE.MeshLambertMaterial();
    const glass = (opacity) => new THREE.MeshLambertMaterial({ transparent: true, opacity, depthWrite: false, polygonOffset: true, polygonOffsetFactor: 2, polygonOffsetUnits: 2 });
    this.materials = { robot: solid(), shell: glass(0.18), mesh: new THREE.MeshLambertMaterial({ flatShading: true, side: THREE.DoubleSide }), stop: glass(0.35), person: solid(), volume: glass(0.2), base: solid(), object: new THREE.MeshLambertMaterial({ flatShading: true, transparent: true, opacity: 0.55 }) };
    this.renderer.localClippingEnabled = true;
    this.materials.volume.clippingPlanes = [new THREE.Plane(UP, 0)]; // above the floor
    this.robot = new Capsules(header.robot.radius_m, this.materials.robot);
    this.shell = new Capsules(header.robot.radius_m, this.materials.shell);
    this.surfaces = new Surfaces(header.robot, data.motion, this.materials.mesh);
    this.stop = new Capsules(header.robot.radius_m, this.materials.stop);
    this.person = new Capsules(header.body.radius_m, this.materials.person);
    const ball = sphere(4);
    this.volumes = data.volumes.limbs.map(() => new Volume(ball, this.materials.volume));
    this.volumeGroup = new THREE.Group();
    this.volumes.forEach((volume) => this.volumeGroup.add(volume.mesh));
    const [bx, by, bz] = header.robot.base_m;
    const [first] = header.robot.ends_m[0]; // the pedestal goes up to the first link where that stands above the base
    const top = Math.max(Math.hypot(first[0] - bx, first[1] - by) < 0.05 ? first[2] : bz, 0.02);
    this.base = new THREE.Mesh(new THREE.CylinderGeometry(0.13, 0.19, top, 32).rotateX(Math.PI / 2), this.materials.base);
    this.base.position.set(bx, by, top / 2);
    this.objects = new THREE.Group();
    for (const { corners, triangles, name } of header.objects ?? []) {
      const geometry = new THREE.BufferGeometry();
      geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(corners), 3));
      geometry.setIndex(triangles);
      const mesh = new THREE.Mesh(geometry, this.materials.object);
      mesh.name = name;
      this.objects.add(mesh);
    }
    const way = (most, radius, onTop) => {
      const made = new Way(most, radius, new THREE.MeshBasicMaterial({ depthTest: !onTop, transparent: onTop }));
      if (onTop) made.mesh.renderOrder = 10;
      return made;
    };
    this.lines = {
      bones: way(header.bones.length, 0.006, true),
      programmed: way(2000, 0.005, false),
      driven: way(1000, 0.007, false),
      stopPath: way(32, 0.006, true),
      toBody: way(1, 0.006, true),
      toVolume: way(1, 0.006, true),
      watched: way(64, 0.012, false),
    };
    const corners = header.watched.map(([x, y]) => new THREE.Vector3(x, y, 0.01));
    this.lines.watched.show(corners.length ? [...corners, corners[0]] : [new THREE.Vector3()]);
    this.scene.add(
      this.robot.group, this.shell.group, this.surfaces.group, this.stop.group, this.person.group, this.volumeGroup, this.base, this.objects, ...Object.values(this.lines).map((one) => one.mesh),
    );
    this.shown = { meshes: true, person: true, volumes: true, skeleton: true, stop: true, paths: true, distance: true };
    this.paint(colours);
    this.home();
  }

  // Colours by name, as the page's theme has them.
  paint(colours) {
    const { materials, lines } = this;
    this.scene.background = new THREE.Color(colours.stage);
    for (const [name, material] of Object.entries(materials)) material.color.set(colours[{ mesh: "robot", shell: "robot", object: "base" }[name] ?? name]);
    for (const [name, one] of Object.entries(lines)) one.mesh.material.color.set(colours[name === "watched" ? "volume" : name]);
    if (this.grid) {
      this.scene.remove(this.grid);
      this.grid.dispose();
    }
    this.grid = new THREE.GridHelper(6, 12, colours.gridMain, colours.grid).rotateX(Math.PI / 2);
    const [bx, by] = this.data.header.robot.base_m;
    this.grid.position.set(Math.round(2 * bx) / 2, Math.round(2 * by) / 2, 0);
    this.scene.add(this.grid);
  }

  // Looks at robot and person from the side of both.
  home() {
    const { header, motion } = this.data;
    const box = new THREE.Box3();
    const path = motion(`${header.order[0]}/ref_m`), body = motion("points");
    for (const array of [path, body]) {
      for (let k = 0; k < array.values.length; k += 3 * 29) {
        const point = new THREE.Vector3(...array.values.subarray(k, k + 3));
        if (Number.isFinite(point.x + point.y + point.z)) box.expandByPoint(point);
      }
    }
    const base = new THREE.Vector3(...header.robot.base_m);
    box.expandByPoint(base);
    const centre = box.getCenter(new THREE.Vector3());
    const person = new THREE.Vector3(), size = box.getSize(new THREE.Vector3());
    between(body, Math.floor(header.count / 2)).slice(0, 3).forEach((x, i) => person.setComponent(i, x));
    const towards = Number.isFinite(person.x) ? person.sub(base).setZ(0).normalize() : new THREE.Vector3(1, 0, 0);
    const side = new THREE.Vector3(towards.y, -towards.x, 0).addScaledVector(towards, 0.35).normalize();
    this.controls.target.copy(centre).setZ(Math.max(0.8, centre.z - 0.15));
    const tall = 1.25, wide = 0.5 * Math.hypot(size.x, size.y) + 0.25; // what must be seen to all sides [m]
    const slope = Math.tan((this.camera.fov * Math.PI) / 360);
    const far = Math.max(tall / slope, wide / (slope * this.camera.aspect));
    this.camera.position.copy(this.controls.target).addScaledVector(side, 0.92 * far).addScaledVector(UP, 0.38 * far);
    this.controls.update();
  }

  resize(width, height) {
    this.renderer.setPixelRatio(Math.min(2, devicePixelRatio));
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.render();
  }

  // One instant; ``at`` counts rows of the data, with a share. Returns what stands beside the scene.
  show(method, at, t_s) {
    const { header, motion } = this.data, { shown, lines } = this;
    const q = between(motion(`${method}/q`), at);
    const robot = posed(header.robot, q);
    this.showRobot(robot);
    this.ends = robot.ends;
    const stopQ = between(motion(`${method}/stop_q`), at);
    const goes = Math.max(...q.map((x, i) => Math.abs(stopQ[i] - x)));
    this.stop.group.visible = shown.stop && goes > 2e-3;
    if (this.stop.group.visible) this.stop.show(posed(header.robot, stopQ).ends);
    lines.stopPath.show(this.stop.group.visible ? this.wayOfTheStop(q, stopQ) : []);
    const body = this.bodyEnds(at);
    this.person.group.visible = shown.person && body.length > 0;
    if (this.person.group.visible) this.person.show(body);
    this.showBones(at);
    const hulls = this.showVolumes(t_s);
    this.showPaths(method, at);
    return this.showDistances(method, robot.ends, body, hulls, at);
  }

  // Links with a mesh as that, in a shell: the capsule that their distances are measured from.
  showRobot({ T, ends }) {
    const { meshes } = this.data.header.robot, nowhere = [new THREE.Vector3(NaN), new THREE.Vector3(NaN)];
    const bare = ends.map((_, link) => !this.shown.meshes || !meshes.includes(link));
    this.robot.show(ends.map((pair, link) => (bare[link] ? pair : nowhere)));
    this.shell.show(ends.map((pair, link) => (bare[link] ? nowhere : pair)));
    this.surfaces.group.visible = this.shown.meshes;
    this.surfaces.show(T);
  }

  wayOfTheStop(q, stopQ) {
    return Array.from({ length: 13 }, (_, k) => posed(this.data.header.robot, q.map((x, i) => x + (k / 12) * (stopQ[i] - x))).tcp);
  }

  bodyEnds(at) {
    const array = this.data.motion("body");
    if (!array.columns) return [];
    const row = between(array, at), found = [];
    for (let k = 0; k < row.length; k += 6) {
      found.push([new THREE.Vector3(row[k], row[k + 1], row[k + 2]), new THREE.Vector3(row[k + 3], row[k + 4], row[k + 5])]);
    }
    return found;
  }

  showBones(at) {
    const row = between(this.data.motion("points"), at);
    const points = this.data.header.bones.flat().map((k) => new THREE.Vector3(row[3 * k], row[3 * k + 1], row[3 * k + 2]));
    const known = points.every((point) => Number.isFinite(point.x));
    this.lines.bones.show(this.shown.skeleton && known ? points : [], { pairs: true });
  }

  showVolumes(t_s) {
    const stored = this.data.volumes.at(t_s);
    this.volumeGroup.visible = this.shown.volumes && stored !== null;
    if (stored === null) this.stored = null;
    if (stored !== null && stored !== this.stored) {
      this.stored = stored;
      this.volumes.forEach((volume) => (volume.mesh.visible = false));
      for (const hull of stored.hulls) {
        this.volumes[hull.limb].show(hull.vertices, hull.radius);
        this.volumes[hull.limb].mesh.visible = true;
      }
    }
    return stored;
  }

  // The programmed path of some seconds around the instant, and the driven one up to it.
  showPaths(method, at) {
    const rate = this.data.header.rate_hz;
    const piece = (name, from, to) => {
      const { rows, values } = this.data.motion(`${method}/${name}`), found = [];
      for (let k = Math.max(0, Math.floor(from)); k <= Math.min(rows - 1, to); k++) {
        const point = new THREE.Vector3(values[3 * k], values[3 * k + 1], values[3 * k + 2]);
        if (Number.isFinite(point.x)) found.push(point);
      }
      return found;
    };
    const seen = { shortest: 0.008 };
    this.lines.programmed.show(this.shown.paths ? piece("ref_m", at - 8 * rate, at + 8 * rate) : [], seen);
    this.lines.driven.show(this.shown.paths ? piece("tcp_m", at - 8 * rate, at) : [], seen);
  }

  // Lines from the robot's surface to the nearest body part and to the nearest volume.
  showDistances(method, ends, body, stored, at) {
    const { header } = this.data, found = { body: null, volume: null };
    const consider = (kind, link, name, p, q, radius) => {
      const pair = surfaces(p, q, header.robot.radius_m[link], radius);
      if (found[kind] === null || pair.distance < found[kind].distance) {
        found[kind] = { ...pair, link: header.robot.links[link], limb: name };
      }
    };
    ends.forEach(([a, b], link) => {
      body.forEach(([c, d], part) => {
        if (!Number.isFinite(c.x + d.x + a.x)) return;
        const [p, q] = nearestOfSegments(a, b, c, d);
        consider("body", link, header.body.parts[part], p, q, header.body.radius_m[part]);
      });
      if (method !== header.order[0] || !Number.isFinite(a.x)) return; // the volumes are those of the run's own method
      for (const hull of stored?.hulls ?? []) {
        const [p, q] = nearestToHull(a, b, hull.vertices);
        consider("volume", link, this.data.volumes.limb_names[hull.limb], p, q, hull.radius);
      }
    });
    const { toBody, toVolume } = this.lines, on = this.shown.distance;
    toBody.show(on && found.body ? [found.body.from, found.body.to] : []);
    toVolume.show(on && found.volume && found.volume.distance > 0 ? [found.volume.from, found.volume.to] : []);
    return found;
  }

  render() {
    this.renderer.render(this.scene, this.camera);
  }
}
