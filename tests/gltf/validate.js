// Runs Khronos' glTF validator over GLB files: node validate.js PATH... (files, or folders searched for *.glb).
// Prints one line per file and every error and warning; exits 1 on any of them, or when there is no file at all.
import { readFileSync, readdirSync, statSync } from 'node:fs';
import { join } from 'node:path';
import validator from 'gltf-validator';

function glbFiles(path) {
  if (!statSync(path).isDirectory()) return [path];
  return readdirSync(path).sort().flatMap((name) => {
    const inner = join(path, name);
    if (statSync(inner).isDirectory()) return glbFiles(inner);
    return name.endsWith('.glb') ? [inner] : [];
  });
}

const SEVERITY = ['error', 'warning'];
const files = process.argv.slice(2).flatMap(glbFiles);
if (files.length === 0) {
  console.error('no GLB file given: node validate.js PATH...');
  process.exit(1);
}
let bad = 0;
for (const file of files) {
  let report;
  try {
    const bytes = new Uint8Array(readFileSync(file));
    report = await validator.validateBytes(bytes, { uri: file, format: 'glb', maxIssues: 0, writeTimestamp: false });
  } catch (failure) {
    console.log(`${file}: not a GLB (${failure})`);
    bad += 1;
    continue;
  }
  const { numErrors, numWarnings, numInfos, numHints, messages } = report.issues;
  console.log(`${file}: ${numErrors} errors, ${numWarnings} warnings, ${numInfos} infos, ${numHints} hints`);
  const seen = new Map();
  for (const { code, severity, message, pointer } of messages) {
    const count = seen.get(code) ?? 0;
    seen.set(code, count + 1);
    // one of a kind is enough of infos and hints, a few of the rest
    if (count < (severity < SEVERITY.length ? 5 : 1)) {
      console.log(`  ${SEVERITY[severity] ?? 'info'} ${code} at ${pointer ?? '/'}: ${message}`);
    }
  }
  if (numErrors + numWarnings > 0) bad += 1;
}
process.exit(bad === 0 ? 0 : 1);
