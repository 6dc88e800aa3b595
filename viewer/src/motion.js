// How a cloud moves between where it was delivered and where it was registered.
import { Matrix4, Quaternion, Vector3 } from "three";

// Returns (share, matrix): fills the matrix that shows a cloud `share` of the way from where it was
// registered (0) back to where it was delivered (1), turning about the cloud's own middle.
export function motionOf(source, fallback) {
  if (!source.motion) return (_, matrix) => matrix.identity();
  const back = new Matrix4().set(...source.motion);
  const centre = new Vector3(...(source.centre ?? fallback));
  const shift = centre.clone().applyMatrix4(back).sub(centre);
  const turn = new Quaternion(), size = new Vector3(), still = new Quaternion();
  back.decompose(new Vector3(), turn, size);
  const rotation = new Quaternion(), at = new Vector3();
  return (share, matrix) => {
    rotation.slerpQuaternions(still, turn, share);
    const scale = 1 + (size.x - 1) * share;
    matrix.compose(at.set(0, 0, 0), rotation, new Vector3(scale, scale, scale));
    at.copy(centre).applyMatrix4(matrix).negate().add(centre).addScaledVector(shift, share);
    return matrix.setPosition(at);
  };
}
