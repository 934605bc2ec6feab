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
    this.meshes = robot.meshes;
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
      mesh.matrix.copy(placements[this.meshes[k].axes]);
      mesh.visible = mesh.matrix.elements.every(Number.isFinite);
      mesh.matrixWorldNeedsUpdate = true;
    });
  }

  // Gives the meshes of some links another material.
  mark(links, marked, plain) {
    this.group.children.forEach((mesh, k) => (mesh.material = links.has(this.meshes[k].link) ? marked : plain));
  }
}

// The edges of a pyramid, given its tip and the corners of its base.
function edges([tip, ...base]) {
  const at = (corner) => new THREE.Vector3(...corner);
  return base.flatMap((corner, k) => [at(tip), at(corner), at(corner), at(base[(k + 1) % base.length])]);
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
    this.drawn = { methods: [header.order[0]], at: 0, t_s: header.start_s };
    this.known = new Map(); // distances of the pictures drawn last
    this.scene.add(new THREE.HemisphereLight(0xffffff, 0x8a8f98, 2.2));
    const sun = new THREE.DirectionalLight(0xffffff, 1.6);
    sun.position.set(2, -3, 5);
    this.scene.add(sun);
    const solid = () => new THREE.MeshLambertMaterial();
    const glass = (opacity) => new THREE.MeshLambertMaterial({ transparent: true, opacity, depthWrite: false, polygonOffset: true, polygonOffsetFactor: 2, polygonOffsetUnits: 2 });
    this.materials = { robot: solid(), shell: glass(0.18), mesh: new THREE.MeshLambertMaterial({ flatShading: true, side: THREE.DoubleSide }), stop: glass(0.22), person: solid(), volume: glass(0.2), base: solid(), object: new THREE.MeshLambertMaterial({ flatShading: true, transparent: true, opacity: 0.55 }), touch: new THREE.MeshLambertMaterial({ transparent: true, opacity: 0.75 }), touchMesh: new THREE.MeshLambertMaterial({ flatShading: true, side: THREE.DoubleSide }) };
    this.renderer.localClippingEnabled = true;
    this.materials.volume.clippingPlanes = [new THREE.Plane(UP, 0)]; // above the floor
    this.robot = new Capsules(header.robot.radius_m, this.materials.robot);
    this.shell = new Capsules(header.robot.radius_m, this.materials.shell);
    this.surfaces = new Surfaces(header.robot, data.motion, this.materials.mesh);
    this.stop = new Capsules(header.robot.radius_m, this.materials.stop);
    this.person = new Capsules(header.body.radius_m, this.materials.person);
    this.touch = new Capsules([...header.robot.radius_m, ...header.body.radius_m].map((r) => 1.01 * r + 0.001), this.materials.touch);
    const ball = sphere(4);
    this.volumes = data.volumes.limbs.map(() => new Volume(ball, this.materials.volume));
    this.volumeGroup = new THREE.Group();
    this.volumes.forEach((volume) => this.volumeGroup.add(volume.mesh));
    const [bx, by, bz] = header.robot.base_m;
    const [first] = header.robot.ends_m[0]; // the pedestal goes up to the first link where that stands above the base
    const own = header.robot.meshes.some(({ axes }) => axes === 0); // the base has a mesh of its own
    const top = own ? bz : Math.max(Math.hypot(first[0] - bx, first[1] - by) < 0.05 ? first[2] : bz, 0.02);
    this.base = new THREE.Mesh(new THREE.CylinderGeometry(0.13, 0.19, top, 32).rotateX(Math.PI / 2), this.materials.base);
    this.base.position.set(bx, by, top / 2);
    this.base.visible = top > 0.005;
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
      cameras: way(8 * header.cameras.length + 1, 0.004, false),
    };
    this.lines.cameras.show(header.cameras.flatMap(({ corners }) => edges(corners)), { pairs: true });
    const corners = header.watched.map(([x, y]) => new THREE.Vector3(x, y, 0.01));
    this.lines.watched.show(corners.length ? [...corners, corners[0]] : [new THREE.Vector3()]);
    this.scene.add(
      this.robot.group, this.shell.group, this.surfaces.group, this.stop.group, this.person.group, this.touch.group, this.volumeGroup, this.base, this.objects, ...Object.values(this.lines).map((one) => one.mesh),
    );
    this.shown = { meshes: true, person: true, volumes: true, skeleton: true, stop: true, paths: true, distance: true, cameras: true };
    this.paint(colours);
    this.home();
  }

  // Colours by name, as the page's theme has them.
  paint(colours) {
    const { materials, lines } = this;
    this.scene.background = new THREE.Color(colours.stage);
    for (const [name, material] of Object.entries(materials)) material.color.set(colours[{ mesh: "robot", shell: "robot", object: "base", touchMesh: "touch" }[name] ?? name]);
    for (const [name, one] of Object.entries(lines)) one.mesh.material.color.set(colours[{ watched: "volume", cameras: "soft" }[name] ?? name]);
    if (this.grid) {
      this.scene.remove(this.grid);
      this.grid.dispose();
    }
    this.grid = new THREE.GridHelper(6, 12, colours.gridMain, colours.grid).rotateX(Math.PI / 2);
    const [bx, by] = this.data.header.robot.base_m;
    this.grid.position.set(Math.round(2 * bx) / 2, Math.round(2 * by) / 2, 0);
    this.scene.add(this.grid);
  }

  // The level direction from which the people hide least of the robot at an instant, with both side by side.
  clearest(method, at) {
    const { header, motion } = this.data, { ends, tcp } = posed(header.robot, between(motion(`${method}/q`), at));
    const body = this.bodyEnds(at), base = new THREE.Vector3(...header.robot.base_m);
    const points = [...ends.flatMap(([a, b]) => [a, a.clone().lerp(b, 0.5), b]), tcp];
    const known = body.filter(([a, b]) => Number.isFinite(a.x + b.x));
    const person = known.reduce((sum, [a, b]) => sum.add(a).add(b), new THREE.Vector3()).divideScalar(Math.max(1, 2 * known.length));
    const towards = known.length ? person.sub(base).setZ(0).normalize() : new THREE.Vector3(1, 0, 0);
    const found = Array.from({ length: 36 }, (_, k) => {
      const side = new THREE.Vector3(Math.cos((k * Math.PI) / 18), Math.sin((k * Math.PI) / 18), 0);
      const sight = side.clone().addScaledVector(UP, 0.42).normalize().multiplyScalar(4);
      return { side, hidden: points.filter((p) => this.isHidden(p, sight, body)).length, ahead: Math.abs(side.dot(towards)) };
    });
    return found.reduce((best, one) => (one.hidden + 4 * one.ahead < best.hidden + 4 * best.ahead - 1e-9 ? one : best));
  }

  isHidden(point, sight, body) {
    const eye = point.clone().add(sight);
    return body.some(([a, b], part) => {
      if (!Number.isFinite(a.x + b.x)) return false;
      const [p, q] = nearestOfSegments(point, eye, a, b);
      return p.distanceTo(q) < this.data.header.body.radius_m[part];
    });
  }

  // Looks at the robots and people of the instant and two seconds around it, from where the robot is seen best.
  home() {
    const { header } = this.data, { methods, at } = this.drawn;
    const { side } = this.clearest(methods[0], at);
    const back = side.clone().multiplyScalar(0.92).addScaledVector(UP, 0.38).normalize();
    const right = UP.clone().cross(back).normalize(), up = back.clone().cross(right);
    const box = new THREE.Box3(); // along right, up and back
    const see = (point, radius) => {
      if (!Number.isFinite(point.x + point.y + point.z)) return;
      const here = new THREE.Vector3(point.dot(right), point.dot(up), point.dot(back));
      box.expandByPoint(here.clone().addScalar(radius)).expandByPoint(here.addScalar(-radius));
    };
    see(new THREE.Vector3(...header.robot.base_m).setZ(0), 0.2);
    for (const then of [at, at - 2 * header.rate_hz, at + 2 * header.rate_hz]) {
      for (const method of methods) {
        const { ends } = posed(header.robot, between(this.data.motion(`${method}/q`), then));
        ends.forEach((pair, link) => pair.forEach((end) => see(end, header.robot.radius_m[link])));
      }
      this.bodyEnds(then).forEach((pair, part) => pair.forEach((end) => see(end, header.body.radius_m[part])));
    }
    const centre = box.getCenter(new THREE.Vector3()), half = box.getSize(new THREE.Vector3()).multiplyScalar(0.5);
    const slope = Math.tan((this.camera.fov * Math.PI) / 360) * 0.94; // a margin around what is to be seen
    const far = Math.max(half.y / slope, half.x / (slope * this.camera.aspect)) + half.z;
    this.controls.target.set(0, 0, 0).addScaledVector(right, centre.x).addScaledVector(up, centre.y).addScaledVector(back, centre.z);
    this.camera.position.copy(this.controls.target).addScaledVector(back, far);
    this.controls.update();
  }

  resize(width, height) {
    this.renderer.setPixelRatio(Math.min(2, devicePixelRatio));
    this.renderer.setSize(width, height, false);
    this.fit();
    this.render();
  }

  // The camera has the shape of one picture of as many as stand side by side.
  fit() {
    const { x, y } = this.renderer.getSize(new THREE.Vector2());
    this.camera.aspect = x / this.drawn.methods.length / y;
    this.camera.updateProjectionMatrix();
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
    const found = this.distances(method, robot.ends, body, hulls, at);
    this.showDistances(found);
    this.showTouches(found.touching, robot.ends, body);
    return found;
  }

  // Links and parts of the body that touch, in red.
  showTouches(touching, ends, body) {
    const nowhere = [new THREE.Vector3(NaN), new THREE.Vector3(NaN)];
    const links = new Set(touching.map(({ link }) => link)), parts = new Set(touching.map(({ part }) => part));
    const on = (marked) => (pair, k) => (marked.has(k) ? pair : nowhere);
    this.touch.show([...ends.map(on(links)), ...body.map(on(this.shown.person ? parts : new Set()))]);
    this.touch.group.visible = touching.length > 0;
    this.surfaces.mark(links, this.materials.touchMesh, this.materials.mesh);
  }

  // Links with a mesh as that, in a shell: the capsule that their distances are measured from.
  showRobot({ T, ends }) {
    const { meshes } = this.data.header.robot, nowhere = [new THREE.Vector3(NaN), new THREE.Vector3(NaN)];
    const covered = new Set(meshes.map(({ link }) => link));
    const bare = ends.map((_, link) => !this.shown.meshes || !covered.has(link));
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
    this.lines.bones.show(this.shown.skeleton ? points : [], { pairs: true }); // of people who are not known: none
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

  // The nearest body part and the nearest volume to the robot's surface, and all pairs that touch.
  distances(method, ends, body, stored, at) {
    const key = `${method} ${at} ${this.shown.volumes}`;
    if (this.known.has(key)) return this.known.get(key);
    const { header } = this.data, found = { body: null, volume: null, touching: [] };
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
        if (surfaces(p, q, header.robot.radius_m[link], header.body.radius_m[part]).distance <= 0) {
          found.touching.push({ link, part, at: p.clone().lerp(q, 0.5) });
        }
      });
      if (method !== header.order[0] || !Number.isFinite(a.x)) return; // the volumes are those of the run's own method
      for (const hull of stored?.hulls ?? []) {
        const [p, q] = nearestToHull(a, b, hull.vertices);
        consider("volume", link, this.data.volumes.limb_names[hull.limb], p, q, hull.radius);
      }
    });
    if (this.known.size > 3) this.known.clear();
    this.known.set(key, found);
    return found;
  }

  // Lines to the nearest body part and to the nearest volume.
  showDistances(found) {
    const { toBody, toVolume } = this.lines, on = this.shown.distance;
    toBody.show(on && found.body && found.body.distance > 0 ? [found.body.from, found.body.to] : []);
    toVolume.show(on && found.volume && found.volume.distance > 0 ? [found.volume.from, found.volume.to] : []);
  }

  // One instant of one method, or of several side by side from the same place. Returns what ``show`` does, for each.
  draw(methods, at, t_s) {
    const fits = methods.length === this.drawn.methods.length;
    this.drawn = { methods, at, t_s };
    if (!fits) this.fit();
    return this.render();
  }

  render() {
    const { methods, at, t_s } = this.drawn, { x, y } = this.renderer.getSize(new THREE.Vector2()), found = [];
    const wide = x / methods.length;
    this.renderer.setScissorTest(methods.length > 1);
    for (let k = methods.length - 1; k >= 0; k--) { // the first one last: it is the one that stays
      found[k] = this.show(methods[k], at, t_s);
      this.renderer.setViewport(k * wide, 0, wide, y);
      this.renderer.setScissor(k * wide, 0, wide, y);
      this.renderer.render(this.scene, this.camera);
    }
    this.told?.(found);
    return found;
  }

  // Where a point of the world is in a picture, as shares of its width and height from the upper left.
  onScreen(point) {
    const { x, y, z } = point.clone().project(this.camera);
    return { x: 0.5 + 0.5 * x, y: 0.5 - 0.5 * y, ahead: z < 1 };
  }
}
