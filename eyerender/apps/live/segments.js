// Many line segments as one object, each with its colour and its width in pixels of the screen, which WebGL's own lines
// lack: every segment is an instance of a quad that the vertex shader stretches from end to end.
import { THREE } from "nicegui-scene";

const VERTEX = `
  attribute vec3 start, end, tint;
  attribute float width;
  uniform vec2 size;
  varying vec3 colour;
  void main() {
    vec4 a = modelViewMatrix * vec4(start, 1.0), b = modelViewMatrix * vec4(end, 1.0);
    float near = -0.051; // what lies behind the viewer is cut off
    if (a.z > near && b.z > near) { gl_Position = vec4(2.0, 2.0, 2.0, 1.0); return; }
    if (a.z > near) a = mix(b, a, (near - b.z) / (a.z - b.z));
    if (b.z > near) b = mix(a, b, (near - a.z) / (b.z - a.z));
    vec4 p = projectionMatrix * a, q = projectionMatrix * b;
    vec2 way = (q.xy / q.w - p.xy / p.w) * size;
    way = length(way) > 1e-6 ? normalize(way) : vec2(1.0, 0.0);
    vec4 place = position.x < 0.5 ? p : q;
    vec2 offset = position.y * width * vec2(-way.y, way.x) + (position.x - 0.5) * 0.5 * width * way;
    place.xy += offset / size * place.w;
    gl_Position = place;
    colour = tint;
  }`;
const FRAGMENT = `
  varying vec3 colour;
  void main() { gl_FragColor = vec4(colour, 1.0); }`;

function numbers(text) {
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  return new Float32Array(bytes.buffer);
}

export default class Segments {
  async create_mesh(...parts) {
    const material = new THREE.ShaderMaterial({
      vertexShader: VERTEX,
      fragmentShader: FRAGMENT,
      uniforms: { size: { value: new THREE.Vector2(1, 1) } },
      side: THREE.DoubleSide,
    });
    this.mesh = new THREE.Mesh(new THREE.InstancedBufferGeometry(), material);
    this.mesh.frustumCulled = false;
    this.mesh.raycast = () => {};
    this.mesh.onBeforeRender = (renderer) => renderer.getSize(material.uniforms.size.value);
    this.draw(...parts);
    return this.mesh;
  }
  draw(ends, tints, widths) {
    const geometry = new THREE.InstancedBufferGeometry();
    const corners = new Float32Array([0, -1, 0, 1, -1, 0, 1, 1, 0, 0, 1, 0]);
    geometry.setAttribute("position", new THREE.BufferAttribute(corners, 3));
    geometry.setIndex([0, 1, 2, 0, 2, 3]);
    const both = new THREE.InstancedInterleavedBuffer(numbers(ends), 6, 1);
    geometry.setAttribute("start", new THREE.InterleavedBufferAttribute(both, 3, 0));
    geometry.setAttribute("end", new THREE.InterleavedBufferAttribute(both, 3, 3));
    geometry.setAttribute("tint", new THREE.InstancedBufferAttribute(numbers(tints), 3));
    geometry.setAttribute("width", new THREE.InstancedBufferAttribute(numbers(widths), 1));
    geometry.instanceCount = both.count;
    this.mesh.geometry.dispose();
    this.mesh.geometry = geometry;
  }
}
