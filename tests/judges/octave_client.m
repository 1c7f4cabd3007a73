% Runs a lab's workflow with clients/matlab, from arrays to reconstructed frames. tests/service/client_libraries.rs
% runs it with SCI_RECON_URL and SCI_RECON_TOKEN. Prints one JSON line.
% Octave must not dump its variables when a test kills it.
crash_dumps_octave_core(false); sigterm_dumps_octave_core(false); sighup_dumps_octave_core(false);
addpath('clients/matlab');
[column, row, frame] = meshgrid(1:160, 1:144, 1:8);
video = single(0.5 * column / 160 + 0.4 * (abs(row - 40 - 2 * frame) < 12 & abs(column - 60 - 3 * frame) < 12));
rand('state', 1);
masks = rand(144, 160, 8) > 0.5;
measurement = sum(masks .* video, 3);
measurement(:, :, 2) = sum(masks .* flipud(video), 3);
truth = cat(4, video, flipud(video));
dark = single(0.25 * ones(144, 160, 2));
raw = single(measurement) + 0.25;
[frames, job] = sci_recon(masks, raw, 'algorithm', 'gap-tv', 'label', 'octave', 'dark', dark, 'saturation', 9, ...
                          'bad_pixels', zeros(144, 160), 'truth', truth, 'snapshots', [0 1], 'tile', [128 16], ...
                          'registration', 'off', 'priority', -1, 'quiet', true);
assert(job.priority == -1 && job.tile.size == 128 && strcmp(job.registration, 'off') && ~isempty(job.truth));
assert(isequal(size(frames), [144 160 8 2]) && isa(frames, 'single'));
for s = 1:2
  again = sum(masks .* frames(:, :, :, s), 3);
  difference = norm(again(:) - measurement(:, :, s)(:)) / norm(measurement(:, :, s)(:));
  assert(difference < 0.05, 'snapshot %d does not fit its measurement: %g', s, difference);
end
[later, same] = sci_recon(job.id, 'quiet', true);
assert(isequal(later, frames) && strcmp(same.id, job.id), 'the frames of an existing job differ');
error_of = @(frames, truth) sqrt(mean((frames(:) - truth(:)) .^ 2));
assert(error_of(frames(:, :, :, 1), video) < 0.08 && error_of(frames(:, :, :, 2), flipud(video)) < 0.08);
% A dark that was left out is reported, with the identifier of the finding.
lastwarn('', '');
[one, wrong] = sci_recon(masks, raw, 'algorithm', 'gap-tv', 'snapshots', 1, 'quiet', true);
assert(isequal(size(one), [144 160 8]));
[~, code] = lastwarn();
assert(strncmp(code, 'sci_recon:', 10), 'no finding is a warning: %s', code);
% The verdict is the service's, and the line of it is printed unless the client is quiet.
assert(any(strcmp(wrong.verdict, {'doubtful', 'bad'})), 'the verdict without a dark is %s', wrong.verdict);
assert(strncmp(wrong.verdict_text, [wrong.verdict ', no expected PSNR'], numel(wrong.verdict) + 18));
line = evalc('sci_recon(wrong.id);');
assert(~isempty(strfind(line, wrong.verdict_text)), 'the verdict is not printed: %s', line);
% The request is repeated, because its connection may be cut.
for k = 1:5
  system(sprintf('curl -s -o /dev/null -X DELETE -H "Authorization: Bearer %s" %s/v1/jobs/%s', ...
                 getenv('SCI_RECON_TOKEN'), getenv('SCI_RECON_URL'), wrong.id));
end
refused = '';
try
  sci_recon(3 * masks, measurement, 'algorithm', 'gap-tv', 'quiet', true);
catch problem
  refused = problem.identifier;
end
assert(strcmp(refused, 'sci_recon:invalid_content'), 'masks above 1: %s', refused);
printf('%s\n', jsonencode(struct('job', job.id)));
