// What names and sizes tell about a scan before a byte of it is sent. The server looks into the files afterwards.

import { bytes, count } from "./base.js";

const IMAGES = /\.(jpe?g|png|ppm|pgm|tiff?|exr)$/i;
const MESHES = /\.(ply|obj|glb|gltf)$/i;
const WHOLE = /\.(sens|mp4|mov|r3d)$/i; // one file that holds all frames
const POSES = /(scan\.json|transforms\.json|\.pose\.txt|\/pose\/|groundtruth\.txt|\.cam$|\.log$|traj[^/]*\.txt|images\.(bin|txt)|odometry\.csv|poses?[^/]*\.(txt|json|csv)|metadata(\.json)?$|frame_\d+\.json|cameras?\/|extrinsics\/|\.traj$|trajectory)/i;

const finding = (severity, where, message, remedy) => ({ severity, where, message, remedy });

/** Findings, most serious first. entries: {name, size, encrypted}, null if they could not be read. */
export function inspected(entries, size, limit, isZip = true) {
  const found = [];
  if (size === 0) found.push(finding("error", "", "This is empty.", "Choose the file or folder of a scan."));
  if (size > limit) {
    found.push(finding("error", "", `This has ${bytes(size)}; the server takes ${bytes(limit)} at most.`,
      "Leave out frames, or ask whoever runs the server to allow more."));
  }
  if (!isZip) {
    found.push(finding("error", "", "This is no zip, or it is cut off at its end.",
      "Give a zip of the scan's folder, or the folder itself; copy it again if it was cut off."));
  }
  if (!entries || found.length) return found;
  const names = entries.map((entry) => entry.name);
  if (!names.length) found.push(finding("error", "", "There are no files in it.", "Choose the folder that holds the frames."));
  const unsafe = names.find((name) => name.startsWith("/") || name.split(/[/\\]/).includes(".."));
  if (unsafe) found.push(finding("error", unsafe, "leads outside of the scan.", "Make the zip anew from inside the scan's folder."));
  const locked = entries.find((entry) => entry.encrypted);
  if (locked) found.push(finding("error", locked.name, "is encrypted.", "Make the zip without a password."));
  const empty = entries.filter((entry) => entry.size === 0 && (IMAGES.test(entry.name) || MESHES.test(entry.name)));
  if (empty.length) {
    found.push(finding("warning", empty[0].name, empty.length > 1 ? `and ${count(empty.length - 1)} more are empty.` : "is empty.",
      "Export them again."));
  }
  if (names.length && !names.some((name) => WHOLE.test(name))) {
    const images = names.filter((name) => IMAGES.test(name)).length;
    if (images < 3) {
      found.push(finding("warning", "", `Only ${count(images)} images were found; 3 frames are the least.`,
        "Choose the folder that holds the images, not one above or below it."));
    }
    if (!names.some((name) => POSES.test(name))) {
      found.push(finding("warning", "", "No file looks like camera poses.",
        "Add the poses as your scanner exports them, or a scan.json that lists them."));
    }
    if (!names.some((name) => MESHES.test(name)) && !names.some((name) => /depth|\.depth\.|\.(npy|exr)$/i.test(name))) {
      found.push(finding("warning", "", "Neither a mesh nor depth images were found.", "Add one of them."));
    }
  }
  return found;
}
